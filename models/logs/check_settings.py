"""Thresholds of the checks of a log."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class CheckSettings(StrictModel):
    """Thresholds of the checks; `check_settings.yaml` gives the reasons."""

    gap_time: Positive = Field(description="maximum pause within a stretch [s]")
    gap_periods: Positive = Field(description="maximum pause within a stretch [sample times]")
    clock_jump: Positive = Field(description="pause above which the clock is assumed to have changed [s]")
    grid_tolerance: Share = Field(description="maximum distance of a stamp from its grid point [sample times]")
    min_samples: int = Field(ge=2, description="minimum number of samples of a stretch")
    jitter: Positive = Field(description="maximum 95th percentile of the deviation of a step [sample times]")
    clock_offset: Positive = Field(description="maximum offset between the stamps of two sources [s]")
    clock_spread: Positive = Field(description="maximum spread of stamps relative to receive times [s]")
    held_share: Share = Field(description="minimum share of times between changes that are multiples of one period")
    silent_share: Share = Field(description="minimum share of silent time for commands in bursts")
    min_silences: int = Field(ge=1, description="minimum number of silences between bursts of commands")
    silent_response: Share = Field(description="minimum response in a silence, as a share of the last command")
    stuck_time: Positive = Field(description="duration of an unchanged reading [s]")
    stuck_command: Share = Field(description="share of the maximum command above which the robot should move")
    zero_command: Positive = Field(description="v [m/s] or omega [rad/s] below which a command counts as zero")
    position_step: Positive = Field(description="step of positions above which they are coarse [m]")
    significant_change: Share = Field(description="minimum significant change, as a share of the maximum command")
    min_changes: int = Field(ge=1, description="minimum number of changes of the command per channel")
    min_total_changes: int = Field(ge=1, description="minimum number of changes per channel in all logs together")
    saturated_share: Share = Field(description="maximum share of samples at the maximum command")
    saturated_levels: int = Field(ge=1, description="minimum number of distinct commands for saturation")
    comparison_step: Positive = Field(description="sample time for the comparison of streams [s]")
    max_dead_time: Positive = Field(description="maximum dead time of a response in the search [s]")
    max_lead: Positive = Field(description="maximum lead of a response over its command in the search [s]")
    max_shift: Positive = Field(description="maximum shift between two sensors in the search [s]")
    lags: tuple[float, ...] = Field(description="candidate time constants of the two equal lags [s]")
    weak_correlation: Share = Field(description="minimum correlation of a response with its command")
    clear_correlation: Share = Field(description="correlation above which a response is clear")
    known_gain: Share = Field(description="relative 95 % interval of a steady-state gain below which it is known")
    wrong_sign: float = Field(ge=-1, lt=0, description="correlation of a response below which its sign is wrong")
    gain_of_v: tuple[Positive, Positive] = Field(description="minimum and maximum ratio of v of two streams")
    gain_of_omega: tuple[Positive, Positive] = Field(description="minimum and maximum ratio of omega of two streams")
    unit_tolerance: Positive = Field(description="tolerance of the natural logarithm of a ratio for a unit")
    typical_skid: Share = Field(description="typical yaw rate of the body over that of the wheels")
    max_unit_gain: Positive = Field(description="ratio above which encoders may count ticks")
    min_duration: Positive = Field(description="minimum duration of a log for the comparison of streams [s]")
    sensor_shift: Positive = Field(description="maximum shift between two sensors [s]")
    response_lead: Positive = Field(description="maximum lead of a response over its command [s]")
    future_share: Share = Field(description="maximum share of the residual variance that later commands explain")
    default_dead_time: Positive = Field(description="dead time of a robot without other information [s]")
    long_dead_time: Positive = Field(description="dead time above which the user is notified [s]")
    dead_zone_resolution: Share = Field(description="maximum step of readings relative to the minimum reading")
    command_change: Share = Field(description="maximum relative change of a command across a short zero")
    zero_duration: Positive = Field(description="maximum duration of a short zero between equal commands [s]")
    publisher_share: Share = Field(description="minimum share of commands with a short zero for a second publisher")
    wheel_delay: Positive = Field(description="maximum delay between the responses of both sides [s]")
    tyre_change: Share = Field(description="maximum change of the yaw rate due to the speed of the wheels")
    bias_drift: Positive = Field(description="maximum drift of the gyro's bias along a log [rad/s]")
    motion_window: Positive = Field(description="duration of a window for the comparison of sensors [s]")
    turning: Share = Field(description="minimum speed of a window in motion, as a share of the maximum")
    rest_speed: tuple[Positive, Positive] = Field(description="maximum reading at rest, v [m/s] and omega [rad/s]")
    same_side: Positive = Field(description="maximum ratio of the gains of gyro and pose to both sides")
    same_skid: Positive = Field(description="maximum ratio of the gains of wheels and body to both sides")
    min_curve: Share = Field(description="minimum residual variance of a linear response for a curve")
    dead_wheel: Share = Field(description="rms speed relative to the fastest wheel below which a wheel is dead")
    uneven_wheels: Positive = Field(description="maximum ratio of the gains of two wheels")
    min_part_variance: Positive = Field(description="minimum variance of a part relative to the log for a gain")
    part_count: int = Field(ge=4, description="number of parts of a log whose gains are compared")
    scale_change: Positive = Field(description="maximum ratio of gains within a log")
    gain_tolerance: Positive = Field(description="maximum ratio of gains of two logs")
    response_tolerance: Positive = Field(description="maximum difference of the response times of two logs [s]")
    significance: Positive = Field(description="significance of a change [standard deviations]")
    clipped_residual: Share = Field(description="maximum residual variance with limits relative to that without")
    spike_scatter: Positive = Field(description="size of a spike relative to the 95th percentile of all deviations")
    spike_span: Positive = Field(description="size of a spike relative to the 5th to 95th percentile of the readings")
    max_spike_share: Share = Field(description="maximum share of readings that are spikes")
    backward_share: Share = Field(description="maximum share of steps that run backwards")
    burst_step: Share = Field(description="minimum ratio of the median step to the mean step")
    min_step: Positive = Field(description="sample time below which rows are decimated [s]")
    decimated_step: Positive = Field(description="sample time after decimation [s]")
    max_rows: int = Field(ge=1000, description="maximum number of rows of a log")
    max_samples: int = Field(ge=1000, description="maximum number of samples of all stretches")
    sample_times: tuple[Positive, Positive] = Field(description="minimum and maximum sample time of a log [s]")
    unit_change: Positive = Field(description="ratio of rms values within a log that indicates a change of units")
    gain_drift: Positive = Field(description="maximum ratio of gains at the end and the start of a log")
    pose_rotation: Positive = Field(description="maximum angle between heading and motion [rad]")
    negative_share: Share = Field(description="maximum ratio of negative to positive readings without a sign")
    clipped_share: Share = Field(description="minimum share of readings of one side at one extreme value")
    clip_ratio: Positive = Field(description="minimum ratio of the commanded speed to the clipped reading")
    echo_correlation: Share = Field(description="correlation with the odometry above which a command is a copy")
    echo_changes: Share = Field(description="minimum share of samples with a change in a copied command")
    echo_noise: Share = Field(description="tolerance for the residual variance of two response shapes")
    latch_spread: Positive = Field(description="minimum 10th to 90th percentile range of leads of a latch [s]")
    ramp_threshold: Share = Field(description="minimum residual variance of a lag for a ramp")
    ramp_residual: Share = Field(description="maximum residual variance of a ramp relative to that of a lag")
    rounded_levels: int = Field(ge=2, description="maximum number of levels of rounded commands")
    rounding_scatter: Share = Field(description="maximum scatter at one command relative to the step between commands")
    shape_ratio: Share = Field(description="maximum ratio of the residual variances of the better and the worse shape")
    lag_share: Share = Field(description="minimum share of variance that a lag explains in addition to a shift")
    max_latch_lead: Positive = Field(description="maximum lead of a response over a change of the command [s]")
    collinearity: Share = Field(description="correlation above which two commands are collinear")
    pose_window: Positive = Field(description="window for the differentiation of poses [s]")

    def max_step(self, period: float) -> float:
        """Return the maximum time between two readings of one stretch [s] for a source with this period [s]."""
        return max(self.gap_time, self.gap_periods * period)


@cache
def check_settings() -> CheckSettings:
    """Load the shipped thresholds."""
    return load_checked(CheckSettings, Path(__file__).with_name("check_settings.yaml"))
