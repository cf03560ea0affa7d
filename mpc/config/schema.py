"""Schema of the controller configuration, with type, unit, range and description of every field.

Defaults, error messages and documentation are derived from the schema. The unit is in brackets at the end of each
description.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

from pydantic import (
    AfterValidator,
    Field,
    SerializeAsAny,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from diffdrive_mpc.models.checked_yaml import check
from diffdrive_mpc.models.errors import ArgumentError
from diffdrive_mpc.models.robot import SampleTime, load_robot
from diffdrive_mpc.models.two_sided import SlewLimit, VelocityLimit, YawRateLimit
from diffdrive_mpc.mpc.config.feature_groups import installed_schemas, is_feature, validate_groups
from diffdrive_mpc.mpc.config.fixed_values import fixed_values
from diffdrive_mpc.mpc.config.group import FeatureGroup, Group, NotNegative, Positive
from diffdrive_mpc.mpc.config.solver import Solver

# The built-in robot file provides the defaults of limits and sample time.
_ROBOT = load_robot()


class ExtraDeadTime(Group):
    """Dead time of the robot in addition to the dead time of the model file."""

    v: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="additional dead time of v_ref [s]")
    omega: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="additional dead time of omega_ref [s]")
    provenance: str = Field("", description="source of the values")


class Weights(Group):
    """Weights of the quadratic cost, which is summed over the steps of the horizon."""

    along: NotNegative = Field(350.0, description="weight of the squared position error along the path [1/m^2]")
    across: NotNegative = Field(700.0, description="weight of the squared position error across the path [1/m^2]")
    heading: NotNegative = Field(
        30.0, description="weight of the squared heading error, which is corrected for side-slip [1/rad^2]"
    )
    v: NotNegative = Field(8.0, description="weight of the squared deviation of v_ref from its feed-forward [s^2/m^2]")
    omega: NotNegative = Field(
        0.1, description="weight of the squared deviation of omega_ref from its feed-forward [s^2/rad^2]"
    )
    v_increment: Positive | None = Field(
        None, description="weight of the squared increment of v_ref per tick; null: derived from margin.v [s^2/m^2]"
    )
    omega_increment: Positive | None = Field(
        None,
        description="weight of the squared increment of omega_ref per tick; null: derived from margin.omega "
        "[s^2/rad^2]",
    )
    terminal: Positive = Field(
        10.0, description="factor of the weights along, across and heading at the end of the horizon [-]"
    )
    soft: Positive = Field(
        50.0, description="linear (exact) penalty on the violation of a soft limit [1/(m/s), 1/(rad/s), 1/m]"
    )
    soft_quadratic: Positive = Field(
        50.0, description="quadratic penalty on the violation of a soft limit [1/(m/s)^2, 1/(rad/s)^2, 1/m^2]"
    )


class Margin(Group):
    """Unmodelled delay that the closed loop tolerates; see docs/tuning.md."""

    # With the minimum weights, the loop tolerates 0.24 to 0.26 s for v and 0.107 to 0.124 s for omega (SM, MBM, SSM);
    # slower robots need larger weights.
    v: Annotated[float, Field(ge=0, le=1)] = Field(0.2, description="tolerated unmodelled delay of v_ref [s]")
    omega: Annotated[float, Field(ge=0, le=1)] = Field(0.11, description="tolerated unmodelled delay of omega_ref [s]")


class Limits(Group):
    """Hard limits of the command, and soft limits of predicted values.

    Each description starts with `hard` or `soft`.
    """

    v: Annotated[VelocityLimit, Field(gt=0)] = Field(
        VelocityLimit(_ROBOT.limits.v), description="hard: maximum |v_ref|; a number, or {forward, reverse} [m/s]"
    )
    omega: Annotated[YawRateLimit, Field(gt=0)] = Field(
        YawRateLimit(_ROBOT.limits.omega), description="hard: maximum |omega_ref|; a number, or {left, right} [rad/s]"
    )
    v_slew: Annotated[SlewLimit, Field(gt=0)] = Field(
        SlewLimit(_ROBOT.command_slew.v),
        description="hard: maximum rate of v_ref while driving; a number, or {accelerate, brake} for increasing and "
        "decreasing |v_ref| [m/s^2]",
    )
    omega_slew: Annotated[SlewLimit, Field(gt=0)] = Field(
        SlewLimit(_ROBOT.command_slew.omega),
        description="hard: maximum rate of omega_ref while driving; a number, or {accelerate, brake} for increasing "
        "and decreasing |omega_ref| [rad/s^2]",
    )
    v_braking: Annotated[float, Field(ge=0.2)] = Field(
        _ROBOT.command_slew.v,
        description="hard: rate at which v_ref goes to zero in BRAKING and FINISHED, independent of v_slew [m/s^2]",
    )
    omega_braking: Annotated[float, Field(ge=0.5)] = Field(
        _ROBOT.command_slew.omega,
        description="hard: rate at which omega_ref goes to zero in BRAKING and FINISHED, independent of omega_slew "
        "[rad/s^2]",
    )
    predicted_v: Positive = Field(1.6, description="soft: maximum predicted |v| [m/s]")
    predicted_omega: Positive = Field(2.2, description="soft: maximum predicted |omega| [rad/s]")
    wheel_speed: Positive = Field(
        round(_ROBOT.limits.wheel_speed * _ROBOT.wheel_radius, 3),
        description="soft: maximum predicted rim speed of the left and right wheels [m/s]",
    )
    min_turn_radius: Positive | None = Field(
        None,
        description="soft: minimum |v| / |omega|, for a robot that must not turn on the spot; null: turns on the spot "
        "are allowed [m]",
    )
    min_commanded_radius: Positive | None = Field(
        None,
        description="hard within slew: minimum |v_ref| / |omega_ref|, for motors with too little torque for tighter "
        "turns; the robot cuts sharper corners of a path; null: no minimum [m]",
    )
    corridor: Positive = Field(0.5, description="soft: maximum predicted distance from the path, to both sides [m]")

    @property
    def min_path_radius(self) -> float:
        """Minimum turn radius of planned paths [m]; 0 if turns on the spot are allowed."""
        return max(self.min_turn_radius or 0.0, self.min_commanded_radius or 0.0)


class Wheels(Group):
    """Wheel geometry that relates a twist to wheel speeds."""

    track: Annotated[float, Field(gt=0, le=10)] = Field(
        0.4,
        description="track that the robot's firmware uses to convert a yaw rate to wheel speeds; larger than the "
        "geometric track of a skid-steer robot [m]",
    )
    encoder_track: Positive = Field(
        _ROBOT.track, description="geometric track, from which the yaw rate of the encoders is computed [m]"
    )


def _check_sign(sign: int) -> int:
    if not sign:
        raise ValueError("give 1, or -1 for a sensor with a reversed sign")
    return sign


Sign = Annotated[int, Field(ge=-1, le=1), AfterValidator(_check_sign)]


class SensorResponse(Group):
    """Properties of all sensors."""

    delay: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="age of a reading at the time of its stamp [s]")


class PoseResponse(SensorResponse):
    """Properties of poses."""

    heading: Annotated[float, Field(ge=-4, le=4)] = Field(
        0.0, description="heading of the poses minus heading of the robot [rad]"
    )


class SpeedResponse(SensorResponse):
    """Properties of a speed sensor."""

    lag: Annotated[float, Field(ge=0, le=1)] = Field(
        0.0, description="lag of the sensor's internal filter, that is the sum of its time constants [s]"
    )
    scale: Annotated[float, Field(ge=0.01, le=100)] = Field(1.0, description="ratio of reading to true value [-]")

    @property
    def total_delay(self) -> float:
        """Sum of delay and lag [s]; at low frequencies a lag is equivalent to a delay."""
        return self.delay + self.lag


class WheelResponse(SpeedResponse):
    """Properties of the encoders."""

    sign: Sign = Field(1, description="-1 if the readings are negative for forward motion [-]")
    turn_sign: Sign = Field(
        1, description="-1 if the readings are negative for a turn to the left, for instance with swapped sides [-]"
    )


class YawRateResponse(SpeedResponse):
    """Properties of a gyro."""

    sign: Sign = Field(1, description="-1 for a gyro that is mounted upside down [-]")


class SensorResponses(Group):
    """Differences between sensor readings and the motion at the time of their stamps."""

    wheels: WheelResponse = WheelResponse()
    yaw_rate: YawRateResponse = YawRateResponse()
    pose: PoseResponse = PoseResponse()


class Compensation(Group):
    """Effects that the controller compensates; all are recommended, and each can be disabled to measure its benefit."""

    dead_time: bool = Field(True, description="compensation of the dead time of model file and extra_dead_time [-]")
    delay: bool = Field(True, description="estimation of command delays in addition to those of the model [-]")
    v_offset: bool = Field(True, description="estimation of forward speed that the model does not explain [-]")
    yaw_gain: bool = Field(True, description="estimation of the ratio of actual to commanded yaw rate [-]")
    side_slip: bool = Field(True, description="estimation of side-slip and turning point [-]")


_NO_CURVED_SLIP = [0.0, 0.0, 0.0]


def _check_slip(values: list[float]) -> list[float]:
    start, *deviations = values
    if not (abs(start) <= 2 and min(deviations) >= 0):
        raise ValueError("give [initial value from -2 to 2, standard deviation, random walk per sqrt(s)]")
    return values


CurvedSlip = Annotated[list[float], Field(min_length=3, max_length=3), AfterValidator(_check_slip)]
"""Initial value, standard deviation, and random walk per sqrt(s) of a parameter of curved slip."""


class Estimator(Group):
    """Standard deviations assumed by the Kalman filter, and thresholds for the rejection of measurements.

    A curved slip is a list of its initial value, standard deviation, and random walk per sqrt(s).
    """

    # Constants for all robots; fixed_values.yaml describes them and their units.
    v_offset_uncertainty: ClassVar[float] = fixed_values()["estimator.v_offset_uncertainty"]
    omega_gain_uncertainty: ClassVar[float] = fixed_values()["estimator.omega_gain_uncertainty"]
    unknown_omega_gain_uncertainty: ClassVar[float] = fixed_values()["estimator.unknown_omega_gain_uncertainty"]
    yaw_gain_uncertainty: ClassVar[float] = fixed_values()["estimator.yaw_gain_uncertainty"]
    turn_ahead_uncertainty: ClassVar[float] = fixed_values()["estimator.turn_ahead_uncertainty"]
    turn_left_uncertainty: ClassVar[float] = fixed_values()["estimator.turn_left_uncertainty"]
    load_shift_uncertainty: ClassVar[float] = fixed_values()["estimator.load_shift_uncertainty"]
    slide_uncertainty: ClassVar[float] = fixed_values()["estimator.slide_uncertainty"]
    gyro_bias_uncertainty: ClassVar[float] = fixed_values()["estimator.gyro_bias_uncertainty"]
    gyro_bias_drift: ClassVar[float] = fixed_values()["estimator.gyro_bias_drift"]
    delay_uncertainty: ClassVar[float] = fixed_values()["estimator.delay_uncertainty"]
    delay_drift: ClassVar[float] = fixed_values()["estimator.delay_drift"]
    max_delay: ClassVar[float] = fixed_values()["estimator.max_delay"]
    slide_evidence: ClassVar[float] = fixed_values()["estimator.slide_evidence"]
    gain_evidence: ClassVar[float] = fixed_values()["estimator.gain_evidence"]
    gain_doubt: ClassVar[float] = fixed_values()["estimator.gain_doubt"]
    delay_doubt: ClassVar[float] = fixed_values()["estimator.delay_doubt"]
    delay_evidence: ClassVar[float] = fixed_values()["estimator.delay_evidence"]
    position_drift: ClassVar[float] = fixed_values()["estimator.position_drift"]
    heading_drift: ClassVar[float] = fixed_values()["estimator.heading_drift"]
    min_yaw_rate: ClassVar[float] = fixed_values()["estimator.min_yaw_rate"]
    min_speed: ClassVar[float] = fixed_values()["estimator.min_speed"]
    surprise: ClassVar[float] = fixed_values()["estimator.surprise"]
    min_gain: ClassVar[float] = fixed_values()["estimator.min_gain"]
    max_gain: ClassVar[float] = fixed_values()["estimator.max_gain"]
    max_wheel_speed_jump: ClassVar[float] = fixed_values()["estimator.max_wheel_speed_jump"]
    max_yaw_rate_jump: ClassVar[float] = fixed_values()["estimator.max_yaw_rate_jump"]

    wheel_speed_noise: Positive = Field(
        0.01, description="standard deviation of the forward speed from the encoders [m/s]"
    )
    wheel_yaw_rate_noise: Positive = Field(
        0.05, description="standard deviation of the yaw rate from the encoders [rad/s]"
    )
    yaw_rate_noise: Positive = Field(0.02, description="standard deviation of the yaw rate of the gyro [rad/s]")
    position_noise: Positive = Field(
        0.005, description="standard deviation of the position of poses without covariance [m]"
    )
    heading_noise: Positive = Field(
        0.0052, description="standard deviation of the heading of poses without covariance [rad]"
    )
    v_input_noise: Positive = Field(0.05, description="standard deviation of the model error, as noise on v_ref [m/s]")
    omega_input_noise: Positive = Field(
        0.1, description="standard deviation of the model error, as noise on omega_ref [rad/s]"
    )
    v_offset_drift: Positive = Field(0.02, description="random walk of the v offset [m/s per sqrt(s)]")
    omega_gain_drift: Positive = Field(0.01, description="random walk of the omega gain [1 per sqrt(s)]")
    longitudinal_gain_uncertainty: Positive = Field(
        0.01, description="initial standard deviation of the ratio of body speed to wheel speed [-]"
    )
    longitudinal_gain_drift: Positive = Field(0.002, description="random walk of the longitudinal gain [1 per sqrt(s)]")
    yaw_gain_drift: Positive = Field(0.015, description="random walk of the yaw gain [1 per sqrt(s)]")
    side_slip: NotNegative = Field(0.0, description="initial ratio of outward lateral speed to v omega [s]")
    side_slip_uncertainty: Positive = Field(0.05, description="initial standard deviation of the side-slip [s]")
    side_slip_drift: Positive = Field(0.02, description="random walk of the side-slip [s per sqrt(s)]")
    turn_ahead_drift: NotNegative = Field(
        0.01, description="random walk of the turning point, ahead of the origin [m per sqrt(s)]"
    )
    turn_left_drift: NotNegative = Field(
        0.01, description="random walk of the turning point, to the left of the origin [m per sqrt(s)]"
    )
    load_shift: NotNegative = Field(
        0.0, description="initial ratio of the backward shift of the turning point to forward acceleration [s^2]"
    )
    load_shift_drift: NotNegative = Field(0.001, description="random walk of the load shift [s^2 per sqrt(s)]")
    slide_drift: NotNegative = Field(
        0.001, description="random walk of the slide per radian of turn [m/rad per sqrt(s)]"
    )
    crab: CurvedSlip = Field(_NO_CURVED_SLIP, description="ratio of lateral speed to the left to forward speed [-]")
    veer: CurvedSlip = Field(_NO_CURVED_SLIP, description="yaw angle per wheel distance [rad/m]")
    forward_coupling: CurvedSlip = Field(
        _NO_CURVED_SLIP, description="ratio of forward speed to the product of the wheels' speed and yaw rate [s/rad]"
    )
    yaw_coupling: CurvedSlip = Field(
        _NO_CURVED_SLIP, description="ratio of yaw rate to the product of the wheels' speed and yaw rate [s/m]"
    )
    track_growth: CurvedSlip = Field(_NO_CURVED_SLIP, description="relative growth of the track per yaw rate [s/rad]")
    lasting_surprise: Positive = Field(
        0.6, description="duration of large innovations after which the filter learns them as slip [s]"
    )
    history: Annotated[float, Field(ge=0.05, le=5)] = Field(
        0.4, description="maximum delay of a pose that is applied at its stamp [s]"
    )
    max_wheel_speed: Positive = Field(5.0, description="maximum accepted forward speed from the encoders [m/s]")
    max_yaw_rate: Positive = Field(10.0, description="maximum accepted yaw rate from the gyro [rad/s]")
    max_position_jump: Positive = Field(0.3, description="maximum accepted distance of a pose from the prediction [m]")
    max_heading_jump: Positive = Field(
        0.6, description="maximum accepted difference of a heading from the prediction [rad]"
    )

    def start(self, slip: str) -> float:
        """Return the initial value of a parameter of curved slip."""
        return float(getattr(self, slip)[0])

    def uncertainty(self, slip: str) -> float:
        """Return the initial standard deviation of a slip parameter."""
        value = getattr(self, slip, None)
        return float(value[1] if isinstance(value, list) else getattr(self, f"{slip}_uncertainty"))

    def drift(self, slip: str) -> float:
        """Return the random walk of a slip parameter per sqrt(s)."""
        value = getattr(self, slip, None)
        return float(value[2] if isinstance(value, list) else getattr(self, f"{slip}_drift"))


class Monitor(Group):
    """Detection of contradictions between motion sensors, and of wheels at their maximum speed."""

    enabled: bool = Field(True, description="detection and rejection of a sensor that the others contradict [-]")
    false_alarm_rate: Annotated[float, Field(gt=0, le=1000)] = Field(
        0.02, description="maximum rate at which valid sensors are rejected [1/h]"
    )
    turn_ratio: Annotated[float, Field(gt=1)] = Field(
        1.6, description="reported ratio of the actual to the expected turn of wheels or body [-]"
    )
    trust_after: Positive = Field(
        1.0, description="duration of agreement during motion after which a rejected sensor is used again [s]"
    )
    wheel_limits: bool = Field(
        True, description="estimation of the maximum wheel speed, to which the reference is slowed down [-]"
    )


class Failure(Group):
    """Response to failed solves and missing measurements."""

    max_reused_ticks: Annotated[int, Field(ge=0, le=100)] = Field(
        5, description="maximum number of ticks for which the last valid plan is used after a failed solve [-]"
    )
    max_pose_age: Positive = Field(0.5, description="time without an accepted pose after which the robot brakes [s]")
    dead_reckoning: NotNegative = Field(
        1.5,
        description="age of the last accepted pose up to which wheels and gyro replace poses, if three standard "
        "deviations of the position are within reentry.band; 0: no dead reckoning [s]",
    )
    max_position_error: Positive = Field(
        1.0, description="distance from the reference above which the robot brakes [m]"
    )
    resume: bool = Field(
        True, description="automatic continuation after a stop when poses and solves are valid again [-]"
    )
    resume_within: Positive = Field(
        1.0,
        description="duration of missing base data, or of a stop due to missing poses, above which the robot waits for "
        "`start` or `resume` [s]",
    )


Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]


class Fence(Group):
    """Rectangle that the robot must not leave: it brakes before its stopping path leaves it, and waits for `start`."""

    enabled: bool = Field(False, description="braking before the robot leaves the rectangle [-]")
    length: Positive = Field(4.0, description="size of the rectangle along its heading [m]")
    width: Positive = Field(3.0, description="size of the rectangle across its heading [m]")
    margin: NotNegative = Field(
        0.1, description="minimum distance between the stopping position and the edges, a reserve for model errors [m]"
    )
    frame: Literal["start", "poses"] = Field(
        "start", description="frame of the rectangle: start pose of the reference, or frame of the poses [-]"
    )
    x: Coordinate = Field(0.0, description="x of the centre of the rectangle in `frame` [m]")
    y: Coordinate = Field(0.0, description="y of the centre of the rectangle in `frame` [m]")
    heading: Annotated[float, Field(ge=-7, le=7)] = Field(
        0.0, description="heading of the rectangle in `frame`, positive to the left [rad]"
    )

    @model_validator(mode="after")
    def _has_room(self) -> Self:
        if 2 * self.margin >= min(self.length, self.width):
            raise ValueError(f"margin = {self.margin:g} m leaves no area of {self.length:g} by {self.width:g} m")
        return self


class Reentry(Group):
    """Return of the robot to its path, and a reference that waits for a lagging robot."""

    # Constants for all robots; fixed_values.yaml describes them and their units.
    heading_wait: ClassVar[float] = fixed_values()["reentry.heading_wait"]
    progress_ramp: ClassVar[float] = fixed_values()["reentry.progress_ramp"]
    min_look_ahead: ClassVar[float] = fixed_values()["reentry.min_look_ahead"]
    window: ClassVar[float] = fixed_values()["reentry.window"]

    enabled: bool = Field(
        True,
        description="return on a smooth path, and a reference that waits; false: the reference is tracked on time [-]",
    )
    band: Positive = Field(
        0.08, description="distance from the path, to both sides, above which the robot rejoins the path [m]"
    )
    heading_band: Positive = Field(0.6, description="heading error above which the robot rejoins the path [rad]")
    wait: Positive = Field(
        0.1, description="lag along the path above which the reference slows down; at twice this lag it waits [m]"
    )
    max_progress: Annotated[float, Field(gt=1, le=2)] = Field(
        1.25, description="maximum rate of the reference's clock while catching up, and speed factor of paths back [-]"
    )
    max_look_ahead: Positive = Field(2.0, description="maximum distance along the path to the rejoining point [m]")
    v_acceleration: Positive = Field(
        _ROBOT.reference_acceleration.v, description="maximum forward acceleration of the path back [m/s^2]"
    )
    omega_acceleration: Positive = Field(
        _ROBOT.reference_acceleration.omega, description="maximum yaw acceleration of the path back [rad/s^2]"
    )
    effort: Annotated[float, Field(gt=0, le=1)] = Field(
        0.75, description="share of the hard limits of v and omega that the path back uses [-]"
    )
    blocked_after: Positive = Field(
        0.5, description="standstill while the reference waits after which the robot counts as blocked [s]"
    )
    blocked_share: Annotated[float, Field(gt=0, le=1)] = Field(
        0.4, description="maximum command to a blocked robot, as a share of the hard limits of v and omega [-]"
    )


class Finish(Group):
    """Conditions for the end of the reference."""

    position: Positive = Field(0.02, description="maximum distance to the end pose [m]")
    speed: Positive = Field(0.02, description="maximum estimated |v| and |omega| of a robot at rest [m/s, rad/s]")
    timeout: NotNegative = Field(
        2.0, description="time after the end of the reference after which the drive finishes in any case [s]"
    )


class TermConfig(Group):
    """User-defined function: a residual of the cost, or a value with soft limits; see docs/tuning.md."""

    file: str = Field(min_length=1, description="Python file, relative to the folder of the configuration [-]")
    function: str = Field(min_length=1, description="name of a casadi.Function in the file [-]")
    name: str = Field("", description="name of the term; empty: name of the function [-]")
    kind: Literal["residual", "soft"] = Field(
        "residual", description="residual: half the square is added to the cost; soft: the value is limited [-]"
    )
    upper: list[float | None] | None = Field(
        None, description="soft: upper limits of the value, row by row; null: no limit [unit of the value]"
    )
    lower: list[float | None] | None = Field(
        None, description="soft: lower limits of the value, row by row; null: no limit [unit of the value]"
    )
    parameters: list[float] = Field([], description="initial stage parameters [unit of the parameters]")


_Schema = TypeVar("_Schema", bound=FeatureGroup)


class ControllerConfig(Group):
    """Configuration of a controller, without the reference.

    In files and dumps, the group of a feature is at the same level as the other groups, by feature name.
    """

    model: str = Field(
        "ssm",
        min_length=1,
        description="velocity model: mbm, sm, ssm, two_delays, lstm, p2_experimental, p2_physical, kinematic "
        "or the path of a model file [-]",
    )
    sample_time: SampleTime = Field(_ROBOT.sample_time, description="period of the ticks [s]")
    horizon: Annotated[int, Field(ge=1, le=200)] = Field(30, description="number of steps of the prediction [-]")
    start_delay: Annotated[float, Field(ge=0, le=10)] = Field(
        0.0, description="standstill before the start of a trajectory that is given by name or file [s]"
    )
    extra_dead_time: ExtraDeadTime = ExtraDeadTime()
    weights: Weights = Weights()
    margin: Margin = Margin()
    limits: Limits = Limits()
    wheels: Wheels = Wheels()
    sensors: SensorResponses = SensorResponses()
    solver: Solver = Solver()
    compensation: Compensation = Compensation()
    estimator: Estimator = Estimator()
    monitor: Monitor = Monitor()
    failure: Failure = Failure()
    fence: Fence = Fence()
    reentry: Reentry = Reentry()
    finish: Finish = Finish()
    terms: list[TermConfig] = Field([], description="user-defined functions in cost and soft limits [-]")
    features: Mapping[str, SerializeAsAny[FeatureGroup]] = Field(
        {}, description="configuration groups of features by name, with keys expert.<name> [-]"
    )

    def __new__(cls, *arguments: object, **values: object) -> Self:
        """Raise ArgumentError, or ConfigError with all mistakes in one line, before pydantic checks the values."""
        if arguments:
            raise ArgumentError(
                f"{cls.__name__}: give keywords, as in horizon=20; load_config('ssm') reads a file or name"
            )
        if values:
            check(cls, values, cls.__name__)
        return super().__new__(cls)

    @model_validator(mode="after")
    def _check_time_limit(self) -> Self:
        limit = self.solver.time_limit
        if limit is not None and limit > self.sample_time:
            raise ValueError(
                f"solver.time_limit: {limit:g} s exceeds sample_time, {self.sample_time:g} s; give seconds"
            )
        return self

    @model_validator(mode="before")
    @classmethod
    def _read_features(cls, data: object) -> object:
        if not isinstance(data, Mapping):
            return data
        groups = {name: data[name] for name in data if name not in cls.model_fields and is_feature(name)}
        features = data.get("features", {})
        if not isinstance(features, Mapping) or not (groups or features):
            return data
        other_values = {name: value for name, value in data.items() if name not in groups}
        return other_values | {"features": validate_groups({**features, **groups})}

    @model_serializer(mode="wrap")
    def _dump(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        data: dict[str, Any] = handler(self)
        features: dict[str, Any] = data.pop("features", {})
        return {**data, **features}

    @classmethod
    def feature_schemas(cls) -> Mapping[str, type[FeatureGroup]]:
        """Return the schemas of installed features by name."""
        return installed_schemas()

    def feature_group(self, name: str, schema: type[_Schema]) -> _Schema:
        """Return the group of a feature, or the defaults of `schema` if the configuration has no such group."""
        group = self.features.get(name)
        if group is None:
            return schema()
        assert isinstance(group, schema)
        return group
