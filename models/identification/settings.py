"""Settings for the division of logs and the verdict on models, read from `settings.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive


class JudgementSettings(StrictModel):
    """Thresholds below which a model is not trusted."""

    low_fit: float = Field(description="[%]")
    refused_fit: float = Field(description="[%]")
    unknown_delay: Positive = Field(description="[-]")
    least_unknown_delay: Positive = Field(description="[s]")
    fit_drop: Positive = Field(description="[percentage points]")
    unexplained: Positive = Field(description="[-]")
    lever_arm: Positive = Field(description="[m]")


class AdviceSettings(StrictModel):
    """When a change of the mapping is advised."""

    rows: int = Field(gt=0, description="to fit, and as many held out, for each trial [-]")
    most_changes: int = Field(gt=0, description="proposals that are put one on top of the other [-]")
    least_gain: Positive = Field(description="of FIT or agreement of the streams [percentage points]")
    tolerance: Positive = Field(description="by which neither may fall [percentage points]")
    clock_tolerance: Positive = Field(description="difference of wheels and poses under a changed clock [-]")


class SensorSettings(StrictModel):
    """Thresholds from which a sensor counts as late or scaled."""

    least_delay: Positive = Field(description="[s]")
    least_scale: Positive = Field(description="of the gyro, beside one [-]")
    least_wheel_scale: Positive = Field(description="of the encoders, logarithm [-]")
    least_slip: Positive = Field(description="encoders over poses, above which wheels slip [-]")
    certain: Positive = Field(description="[standard deviations]")


class SlipSettings(StrictModel):
    """Mean of a slip, its standard deviation, and that between surfaces."""

    side_slip: tuple[Positive, Positive, Positive] = Field(description="lateral speed, outward, over v omega [s]")
    load_shift: tuple[Positive, Positive, Positive] = Field(description="turning point over acceleration [s^2]")


class IdentificationSettings(StrictModel):
    """Sizes and thresholds of the identification from logs."""

    fit_share: Positive = Field(description="of each log to identify from [-]")
    shares: tuple[Positive, Positive] = Field(description="least and largest share to identify from [-]")
    most_rows: dict[str, int] = Field(
        description="of a log that are fitted, and that are scored, without and with effects"
    )
    part_time: Positive = Field(description="that is taken or left together [s]")
    block_time: Positive = Field(description="that is drawn together for the uncertainty of a comparison [s]")
    fewest_readings: int = Field(gt=0, description="[-]")
    pose_window: Positive = Field(description="[s]")
    horizons: tuple[Positive, ...] = Field(description="horizons of the open-loop pose error [s]")
    start_every: Positive = Field(description="time between two starts [s]")
    limit_margin: float = Field(ge=1, description="[-]")
    certain: Positive = Field(description="[standard deviations]")
    least_slew: Annotated[float, Field(gt=0, le=1)] = Field(description="part of the slew found [-]")
    settled: Annotated[float, Field(gt=0, lt=1)] = Field(description="[-]")
    look_ahead: Positive = Field(description="horizon over the settling time [-]")
    least_steps: int = Field(ge=1, le=200, description="[-]")
    most_steps: int = Field(ge=1, le=200, description="[-]")
    lengths: dict[str, Positive] = Field(description="by dotted key of the configuration [m]")
    expert: tuple[str, ...] = Field(description="groups and keys of a configuration that stand under `expert:` in it")
    least_noise: dict[str, Positive] = Field(description="by the key of the group estimator [SI units]")
    sensors: SensorSettings
    slip: SlipSettings = Field(description="prior of what the filter of a configuration begins with")
    warn: JudgementSettings
    advice: AdviceSettings = Field(description="when a change of the mapping is advised")


@cache
def identification_settings() -> IdentificationSettings:
    """Read `settings.yaml`; raises ConfigError on a mistake in it."""
    return load_checked(IdentificationSettings, Path(__file__).with_name("settings.yaml"))
