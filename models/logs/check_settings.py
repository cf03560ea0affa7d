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
    """Thresholds; the reasons are in `check_settings.yaml`."""

    gap_time: Positive = Field(description="a longer pause ends a stretch [s]")
    gap_periods: Positive = Field(description="a longer pause ends a stretch [sample times]")
    clock_jump: Positive = Field(description="a pause longer than this is another clock [s]")
    grid_tolerance: Share = Field(description="a stamp this close to a grid point belongs to it [sample times]")
    fewest_samples: int = Field(ge=2, description="of a stretch")
    jitter: Positive = Field(description="95th percentile of a step's deviation [sample times]")
    clock_offset: Positive = Field(description="between the stamps of two sources [s]")
    clock_spread: Positive = Field(description="of stamps against receive times [s]")
    held_share: Share = Field(description="of the times between changes that are multiples of one period")
    silent_share: Share = Field(description="of the time, in which commands that come in bursts are silent")
    fewest_silences: int = Field(ge=1, description="between bursts of commands")
    silent_answer: Share = Field(description="of the last command, that a robot still answers in a silence")
    stuck_time: Positive = Field(description="a reading that stays the same [s]")
    stuck_command: Share = Field(description="of the largest command; the robot should move")
    least_command: Positive = Field(description="largest v [m/s] or omega [rad/s] that is more than rounding")
    significant_change: Share = Field(description="of the largest command")
    fewest_changes: int = Field(ge=1, description="of a command, per channel")
    refused_changes: int = Field(ge=1, description="of a command in all logs, per channel; fewer make no model")
    saturated_share: Share = Field(description="of the samples at the largest command")
    saturated_levels: int = Field(ge=1, description="distinct commands, above which a plateau is no design")
    compared_every: Positive = Field(description="step at which streams are compared [s]")
    longest_lag: Positive = Field(description="within which an answer is looked for [s]")
    longest_lead: Positive = Field(description="by which an answer may come first [s]")
    longest_shift: Positive = Field(description="between two sensors that is looked for [s]")
    lags: tuple[float, ...] = Field(description="of each of two equal lags that are tried [s]")
    weak_correlation: Share = Field(description="of an answer with its command")
    clear_correlation: Share = Field(description="of an answer with its command")
    wrong_sign: float = Field(ge=-1, lt=0, description="correlation of an answer with its command")
    gain_of_v: tuple[Positive, Positive] = Field(description="smallest and largest of v over another v")
    gain_of_omega: tuple[Positive, Positive] = Field(description="smallest and largest of omega over another omega")
    unit_tolerance: Positive = Field(description="natural logarithm of a ratio over the factor of a unit")
    usual_skid: Share = Field(description="yaw rate of a body over that of its wheels")
    most_unit_gain: Positive = Field(description="ratio, above which encoders may count ticks")
    shortest_drive: Positive = Field(description="of a log whose streams are compared [s]")
    sensor_shift: Positive = Field(description="between two sensors [s]")
    earliest_response: Positive = Field(description="before the command [s]")
    foresight: Share = Field(description="of what past commands leave unexplained that later ones explain")
    usual_response: Positive = Field(description="dead time of a robot [s]")
    late_response: Positive = Field(description="dead time that is said [s]")
    dead_resolution: Share = Field(description="step of readings over the least one")
    same_command: Share = Field(description="change of a command over a moment of zero, of its size")
    longest_moment: Positive = Field(description="of a zero between two equal commands [s]")
    publisher_share: Share = Field(description="of the commands that such a moment follows")
    late_wheel: Positive = Field(description="between the answers of two sides [s]")
    tyre_change: Share = Field(description="of the yaw rate, by the speed of the wheels")
    bias_drift: Positive = Field(description="of the gyro's bias along a log [rad/s]")
    curve_least: Share = Field(description="of the variance that a linear response leaves unexplained")
    dead_wheel: Share = Field(description="rms speed of a wheel over that of the fastest")
    uneven_wheels: Positive = Field(description="gain of one wheel over that of another")
    least_part_change: Positive = Field(description="variance of a part that tells of a gain, over the whole log's")
    parts: int = Field(ge=4, description="of a log whose gains are compared")
    scale_change: Positive = Field(description="ratio of gains within a log")
    same_gain: Positive = Field(description="ratio of gains of two logs")
    same_response: Positive = Field(description="between the answers of two logs [s]")
    certain: Positive = Field(description="[standard deviations]")
    clipped_rest: Share = Field(description="of the unexplained variance that a level leaves")
    spike_scatter: Positive = Field(description="over the 95th percentile of leaps out and back")
    spike_span: Positive = Field(description="over the 5th to 95th percentile of the readings")
    most_spikes: Share = Field(description="of the readings")
    disordered: Share = Field(description="of the steps that run backwards")
    burst_step: Share = Field(description="median step over the mean one")
    shortest_step: Positive = Field(description="sample time, below which rows are left out [s]")
    needed_step: Positive = Field(description="sample time that they are thinned to [s]")
    most_rows: int = Field(ge=1000, description="of a log that are used")
    most_samples: int = Field(ge=1000, description="of all stretches together, evenly sampled")
    sample_times: tuple[Positive, Positive] = Field(description="shortest and longest of a log [s]")
    unit_change: Positive = Field(description="ratio of rms values in the middle of a log that only a unit explains")
    gain_drift: Positive = Field(description="ratio of gains at the end and at the beginning of a log")
    turned_pose: Positive = Field(description="heading against motion [rad]")
    never_negative: Share = Field(description="of the readings below zero over those above")
    clipped_readings: Share = Field(description="of the readings of one side at one largest value")
    beyond_clip: Positive = Field(description="speed asked for over the value at which a reading is clipped")
    echo: Share = Field(description="correlation of odometry with the command that repeats it")
    echo_changes: Share = Field(description="of the samples, at which a command changes that repeats readings")
    echo_noise: Share = Field(description="of the variance, within which shapes are alike")
    latch_spread: Positive = Field(description="of leads at changes of the command, 10th to 90th percentile [s]")
    ramp_least: Share = Field(description="of the variance; what less a lag leaves unexplained is not looked at")
    ramp_rest: Share = Field(description="of the variance that a lag leaves unexplained")
    rounded_levels: int = Field(ge=2, description="largest command over the step between commands")
    rounded_rest: Share = Field(description="scatter at one command over the step between commands")
    shape: Share = Field(description="of the variance that a better shape leaves of what the other does not explain")
    lag_share: Share = Field(description="of the variance that a lag between sensors explains and a shift does not")
    longest_latch: Positive = Field(
        description="before a change of the command, within which an answer is looked for [s]"
    )
    collinear: Share = Field(description="correlation of the two commands")
    pose_window: Positive = Field(description="over which poses are turned into speeds [s]")

    def longest_step(self, period: float) -> float:
        """Compute the maximum time between two readings of one stretch [s] for a source with this period [s]."""
        return max(self.gap_time, self.gap_periods * period)


@cache
def check_settings() -> CheckSettings:
    """Load the shipped thresholds."""
    return load_checked(CheckSettings, Path(__file__).with_name("check_settings.yaml"))
