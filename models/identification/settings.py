"""Settings for the division of logs and the grading of models, read from `settings.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive


class JudgementSettings(StrictModel):
    """Thresholds for warnings about a model."""

    low_fit: float = Field(description="FIT below which a warning is issued [%]")
    refused_fit: float = Field(description="FIT below which no configuration is written [%]")
    unknown_delay: Positive = Field(description="relative standard deviation of an unknown delay [-]")
    min_unknown_delay: Positive = Field(description="minimum standard deviation of an unknown delay [s]")
    fit_drop: Positive = Field(description="maximum decrease of FIT from training to validation [percentage points]")
    unexplained: Positive = Field(
        description="maximum ratio of a correlation of residuals with commands to its 95 % bound [-]"
    )
    lever_arm: Positive = Field(description="maximum distance of the pose point from the centre of rotation [m]")


class AdviceSettings(StrictModel):
    """Settings of the rule that accepts changes of the mapping."""

    rows: int = Field(gt=0, description="number of training rows, and of held-out rows, of a trial [-]")
    max_changes: int = Field(gt=0, description="maximum number of combined proposals [-]")
    min_gain: Positive = Field(description="minimum gain of FIT or agreement of the streams [percentage points]")
    tolerance: Positive = Field(description="maximum loss of FIT or agreement [percentage points]")
    clock_tolerance: Positive = Field(description="maximum difference of wheels and poses after a clock change [-]")


class SensorSettings(StrictModel):
    """Thresholds above which a sensor counts as late or scaled."""

    min_delay: Positive = Field(description="minimum delay [s]")
    max_delay_interval: Positive = Field(description="maximum half of the 95 % interval of a delay [s]")
    min_scale: Positive = Field(description="minimum difference of the gyro's scale from one [-]")
    min_wheel_scale: Positive = Field(description="minimum logarithm of the encoders' scale [-]")
    min_slip: Positive = Field(description="ratio of encoder and pose distance above which the wheels slip [-]")
    significance: Positive = Field(description="minimum significance of a delay or scale [standard deviations]")


class SlipSettings(StrictModel):
    """Prior of each slip parameter: mean, standard deviation, and standard deviation between surfaces."""

    side_slip: tuple[Positive, Positive, Positive] = Field(description="ratio of outward lateral speed to v omega [s]")
    load_shift: tuple[Positive, Positive, Positive] = Field(
        description="shift of the turning point per acceleration [s^2]"
    )


class IdentificationSettings(StrictModel):
    """Sizes and thresholds of the identification from logs."""

    fit_share: Positive = Field(description="share of each log for the identification [-]")
    shares: tuple[Positive, Positive] = Field(description="minimum and maximum of `fit_share` [-]")
    max_rows: dict[str, int] = Field(
        description="maximum number of training rows and of validation rows, without and with effects [-]"
    )
    part_time: Positive = Field(description="length of the parts selected from a long log [s]")
    block_time: Positive = Field(description="length of the resampled blocks for the uncertainty of a comparison [s]")
    min_readings: int = Field(gt=0, description="minimum number of readings of each signal in a record [-]")
    pose_window: Positive = Field(description="window over which displacements are compared with poses [s]")
    horizons: tuple[Positive, ...] = Field(description="horizons of the open-loop pose error [s]")
    start_every: Positive = Field(description="time between the starts of two predictions [s]")
    limit_margin: float = Field(ge=1, description="ratio of predicted limit to commanded limit [-]")
    slew_margin: Positive = Field(description="margin of the slew limit [standard deviations]")
    min_slew: Annotated[float, Field(gt=0, le=1)] = Field(description="minimum share of the identified slew [-]")
    settling_tolerance: Annotated[float, Field(gt=0, lt=1)] = Field(description="tolerance of the settling time [-]")
    look_ahead: Positive = Field(description="ratio of the horizon to the settling time [-]")
    min_steps: int = Field(ge=1, le=200, description="minimum horizon [steps]")
    max_steps: int = Field(ge=1, le=200, description="maximum horizon [steps]")
    lengths: dict[str, Positive] = Field(description="default lengths by dotted key of the configuration [m]")
    pose_times: dict[str, Positive] = Field(description="default times for late poses by dotted key [s]")
    expert: tuple[str, ...] = Field(description="groups and keys of a configuration that belong under `expert:`")
    min_noise: dict[str, Positive] = Field(description="minimum noise by key of the group estimator [SI units]")
    sensors: SensorSettings
    slip: SlipSettings = Field(description="prior of the filter's initial slip estimate")
    warn: JudgementSettings
    advice: AdviceSettings = Field(description="rule that accepts changes of the mapping")


@cache
def identification_settings() -> IdentificationSettings:
    """Load `settings.yaml`; raise ConfigError if the file is invalid."""
    return load_checked(IdentificationSettings, Path(__file__).with_name("settings.yaml"))
