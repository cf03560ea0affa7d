"""Schema of the configuration of a controller, with type, unit, range and description of every field.

The schema is the single source of defaults, error messages and documentation. Units are in brackets at the end of each
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

from diffdrive_mpc.models.robot import SampleTime, load_robot
from diffdrive_mpc.models.two_sided import SlewLimit, VelocityLimit, YawRateLimit
from diffdrive_mpc.mpc.config.feature_groups import checked_groups, installed_schemas, is_feature
from diffdrive_mpc.mpc.config.fixed_values import fixed_values
from diffdrive_mpc.mpc.config.group import FeatureGroup, Group, NotNegative, Positive
from diffdrive_mpc.mpc.config.solver import Solver

# The defaults of limits and sample time are those of the built-in robot file.
_ROBOT = load_robot()


class ExtraDeadTime(Group):
    """Dead time of the robot in addition to that of the model file."""

    v: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="added to the forward channel [s]")
    omega: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="added to the yaw channel [s]")
    provenance: str = Field("", description="how the values were found")


class Weights(Group):
    """Weights of the quadratic cost, each summed over the steps of the horizon."""

    along: NotNegative = Field(350.0, description="squared position error along the path [1/m^2]")
    across: NotNegative = Field(700.0, description="squared position error across the path [1/m^2]")
    heading: NotNegative = Field(30.0, description="squared heading error, corrected for side-slip [1/rad^2]")
    v: NotNegative = Field(8.0, description="squared deviation of v_ref from its feed-forward [s^2/m^2]")
    omega: NotNegative = Field(0.1, description="squared deviation of omega_ref from its feed-forward [s^2/rad^2]")
    v_increment: Positive | None = Field(
        None, description="squared increment of v_ref from tick to tick; null: from margin.v [s^2/m^2]"
    )
    omega_increment: Positive | None = Field(
        None, description="squared increment of omega_ref from tick to tick; null: from margin.omega [s^2/rad^2]"
    )
    terminal: Positive = Field(10.0, description="factor on the pose errors at the end of the horizon [-]")
    soft: Positive = Field(
        50.0, description="exact linear penalty on the violation of a soft limit [1/(m/s), 1/(rad/s), 1/m]"
    )
    soft_quadratic: Positive = Field(
        50.0, description="quadratic penalty on the violation of a soft limit [1/(m/s)^2, 1/(rad/s)^2, 1/m^2]"
    )


class Margin(Group):
    """Delay in addition to the model's that the closed loop tolerates; see docs/tuning.md."""

    # The minimum weights tolerate 0.24 to 0.26 s and 0.107 to 0.124 s (SM, MBM, SSM); slower robots need larger
    # weights.
    v: Annotated[float, Field(ge=0, le=1)] = Field(0.2, description="unknown delay of v_ref [s]")
    omega: Annotated[float, Field(ge=0, le=1)] = Field(0.11, description="unknown delay of omega_ref [s]")


class Limits(Group):
    """Hard limits of the command, and soft limits of predicted values."""

    v: Annotated[VelocityLimit, Field(gt=0)] = Field(
        VelocityLimit(_ROBOT.limits.v), description="hard: |v_ref|; a number, or {forward, reverse} [m/s]"
    )
    omega: Annotated[YawRateLimit, Field(gt=0)] = Field(
        YawRateLimit(_ROBOT.limits.omega), description="hard: |omega_ref|; a number, or {left, right} [rad/s]"
    )
    v_slew: Annotated[SlewLimit, Field(gt=0)] = Field(
        SlewLimit(_ROBOT.command_slew.v),
        description="hard: rate of change of v_ref while driving; a number, or {accelerate, brake} for increasing and "
        "decreasing |v_ref| [m/s^2]",
    )
    omega_slew: Annotated[SlewLimit, Field(gt=0)] = Field(
        SlewLimit(_ROBOT.command_slew.omega),
        description="hard: rate of change of omega_ref while driving; a number, or {accelerate, brake} for increasing "
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
    predicted_v: Positive = Field(1.6, description="soft: predicted |v| [m/s]")
    predicted_omega: Positive = Field(2.2, description="soft: predicted |omega| [rad/s]")
    wheel_speed: Positive = Field(
        round(_ROBOT.limits.wheel_speed * _ROBOT.wheel_radius, 3),
        description="soft: speed of the left and right wheels at the rim, from the predicted twist [m/s]",
    )
    min_turn_radius: Positive | None = Field(
        None,
        description="soft: minimum |v| / |omega|, for a robot that must not turn on the spot; null: turns on the spot "
        "are allowed [m]",
    )
    min_commanded_radius: Positive | None = Field(
        None,
        description="hard within slew: minimum |v_ref| / |omega_ref|, for motors without the torque for tighter turns; "
        "the robot cuts sharper corners of a path [m]",
    )
    corridor: Positive = Field(0.5, description="soft: predicted distance from the path, to both sides [m]")

    @property
    def min_path_radius(self) -> float:
        """Minimum turn radius of planned paths [m]; 0: turns on the spot are allowed."""
        return max(self.min_turn_radius or 0.0, self.min_commanded_radius or 0.0)


class Wheels(Group):
    """Wheel geometry, which relates a twist to wheel speeds."""

    track: Annotated[float, Field(gt=0, le=10)] = Field(
        0.4,
        description="track with which the robot's firmware converts a yaw rate to wheel speeds; for a skid-steer robot "
        "it is larger than the geometric track [m]",
    )
    encoder_track: Positive = Field(
        _ROBOT.track, description="geometric track, with which the yaw rate of the encoders was computed [m]"
    )


def _check_sign(sign: int) -> int:
    if not sign:
        raise ValueError("give 1, or -1 for a sensor with reversed sign")
    return sign


Sign = Annotated[int, Field(ge=-1, le=1), AfterValidator(_check_sign)]


class SensorResponse(Group):
    """Properties of all sensors."""

    delay: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="age of a reading at the time of its stamp [s]")


class PoseResponse(SensorResponse):
    """Properties of poses."""

    heading: Annotated[float, Field(ge=-4, le=4)] = Field(
        0.0, description="angle by which the heading of poses is ahead of the robot's [rad]"
    )


class SpeedResponse(SensorResponse):
    """Properties of a sensor of speed."""

    lag: Annotated[float, Field(ge=0, le=1)] = Field(
        0.0, description="lag of the sensor's own filter, the sum of its time constants [s]"
    )
    scale: Annotated[float, Field(ge=0.01, le=100)] = Field(1.0, description="reading over true value [-]")

    @property
    def total_delay(self) -> float:
        """Sum of delay and lag [s]; for slow motion a lag is equivalent to a delay."""
        return self.delay + self.lag


class WheelResponse(SpeedResponse):
    """Properties of the encoders."""

    sign: Sign = Field(1, description="-1 if the readings are negative for forward motion [-]")
    turn_sign: Sign = Field(
        1, description="-1 if the readings are negative for a turn to the left, as with swapped sides [-]"
    )


class YawRateResponse(SpeedResponse):
    """Properties of a gyro."""

    sign: Sign = Field(1, description="-1 for a gyro that is mounted upside down [-]")


class SensorResponses(Group):
    """Differences between the readings of sensors and the motion at their stamps."""

    wheels: WheelResponse = WheelResponse()
    yaw_rate: YawRateResponse = YawRateResponse()
    pose: PoseResponse = PoseResponse()


class Compensation(Group):
    """Effects that the controller compensates; all are recommended, and disabling an effect shows its benefit."""

    dead_time: bool = Field(True, description="predict over the dead time of model file and extra_dead_time [-]")
    delay: bool = Field(True, description="estimate delays of the commands in addition to the model's [-]")
    v_offset: bool = Field(True, description="estimate forward speed that the model does not explain [-]")
    yaw_gain: bool = Field(True, description="estimate the ratio of the robot's yaw rate to the commanded one [-]")
    side_slip: bool = Field(True, description="estimate side-slip and turning point [-]")


_FLAT = [0.0, 0.0, 0.0]


def _check_slip(values: list[float]) -> list[float]:
    start, *deviations = values
    if not (abs(start) <= 2 and min(deviations) >= 0):
        raise ValueError("give [start from -2 to 2, its standard deviation, its random walk per sqrt(s)]")
    return values


CurvedSlip = Annotated[list[float], Field(min_length=3, max_length=3), AfterValidator(_check_slip)]
"""Start, its standard deviation and random walk per sqrt(s) of a curved slip."""


class Estimator(Group):
    """Noise assumed by the Kalman filter (standard deviations), and thresholds for rejecting measurements.

    Curved slips are lists of their start, its standard deviation, and their random walk per sqrt(s).
    """

    # Constants for all robots, with their meaning and unit in fixed_values.yaml.
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

    wheel_speed_noise: Positive = Field(0.01, description="forward speed from the encoders [m/s]")
    wheel_yaw_rate_noise: Positive = Field(0.05, description="yaw rate from the encoders [rad/s]")
    yaw_rate_noise: Positive = Field(0.02, description="yaw rate of the gyro [rad/s]")
    position_noise: Positive = Field(0.005, description="position of poses without covariance [m]")
    heading_noise: Positive = Field(0.0052, description="heading of poses without covariance [rad]")
    v_input_noise: Positive = Field(0.05, description="model error, as noise on v_ref [m/s]")
    omega_input_noise: Positive = Field(0.1, description="model error, as noise on omega_ref [rad/s]")
    v_offset_drift: Positive = Field(0.02, description="random walk of the v offset [m/s per sqrt(s)]")
    omega_gain_drift: Positive = Field(0.01, description="random walk of the omega gain [1 per sqrt(s)]")
    longitudinal_gain_uncertainty: Positive = Field(0.01, description="speed of body over wheels, at the start [-]")
    longitudinal_gain_drift: Positive = Field(0.002, description="random walk of the longitudinal gain [1 per sqrt(s)]")
    yaw_gain_drift: Positive = Field(0.015, description="random walk of the yaw gain [1 per sqrt(s)]")
    side_slip: NotNegative = Field(0.0, description="outward lateral speed over v omega, at the start [s]")
    side_slip_uncertainty: Positive = Field(0.05, description="lateral speed over v omega, at the start [s]")
    side_slip_drift: Positive = Field(0.02, description="random walk of the side-slip [s per sqrt(s)]")
    turn_ahead_drift: NotNegative = Field(
        0.01, description="random walk of the turning point, ahead of the origin [m per sqrt(s)]"
    )
    turn_left_drift: NotNegative = Field(
        0.01, description="random walk of the turning point, to the left of the origin [m per sqrt(s)]"
    )
    load_shift: NotNegative = Field(
        0.0, description="backward shift of the turning point over forward acceleration, at the start [s^2]"
    )
    load_shift_drift: NotNegative = Field(0.001, description="random walk of the load shift [s^2 per sqrt(s)]")
    slide_drift: NotNegative = Field(
        0.001, description="random walk of the slide per radian turned [m/rad per sqrt(s)]"
    )
    crab: CurvedSlip = Field(_FLAT, description="lateral speed, to the left, over forward speed [-]")
    veer: CurvedSlip = Field(_FLAT, description="yaw angle per distance that the wheels drive [rad/m]")
    forward_coupling: CurvedSlip = Field(
        _FLAT, description="forward speed over product of the wheels' speed and yaw rate [s/rad]"
    )
    yaw_coupling: CurvedSlip = Field(_FLAT, description="yaw rate over product of the wheels' speed and yaw rate [s/m]")
    track_growth: CurvedSlip = Field(_FLAT, description="relative growth of the track per yaw rate [s/rad]")
    lasting_surprise: Positive = Field(
        0.6, description="duration of large innovations after which they count as slip, which is learned [s]"
    )
    history: Annotated[float, Field(ge=0.05, le=5)] = Field(
        0.4, description="maximum delay with which a pose may arrive to be applied at its stamp [s]"
    )
    max_wheel_speed: Positive = Field(5.0, description="maximum accepted forward speed from the encoders [m/s]")
    max_yaw_rate: Positive = Field(10.0, description="maximum accepted yaw rate from the gyro [rad/s]")
    max_position_jump: Positive = Field(0.3, description="maximum accepted distance of a pose from the prediction [m]")
    max_heading_jump: Positive = Field(
        0.6, description="maximum accepted difference of a heading from the prediction [rad]"
    )

    def start(self, slip: str) -> float:
        """Return the value of a curved slip at the start of a drive."""
        return float(getattr(self, slip)[0])

    def uncertainty(self, slip: str) -> float:
        """Return the standard deviation of a slip at the start of a drive."""
        value = getattr(self, slip, None)
        return float(value[1] if isinstance(value, list) else getattr(self, f"{slip}_uncertainty"))

    def drift(self, slip: str) -> float:
        """Return the random walk of a slip per sqrt(s)."""
        value = getattr(self, slip, None)
        return float(value[2] if isinstance(value, list) else getattr(self, f"{slip}_drift"))


class Monitor(Group):
    """Thresholds for contradictions between motion sensors, and for the return of a rejected sensor."""

    enabled: bool = Field(True, description="detect a sensor that the others contradict, and ignore it [-]")
    false_alarm_rate: Annotated[float, Field(gt=0, le=1000)] = Field(
        0.02, description="maximum rate of rejected sensors while all sensors are valid [1/h]"
    )
    turn_ratio: Annotated[float, Field(gt=1)] = Field(
        1.6, description="ratio of a turn of wheels or body to that by the tracks, beyond which it is reported [-]"
    )
    trust_after: Positive = Field(
        1.0, description="time of agreement in motion after which a rejected sensor is used again [s]"
    )
    wheel_limits: bool = Field(
        True, description="learn the speed that the wheels do not exceed, and slow the reference down to it [-]"
    )


class Failure(Group):
    """Behaviour after a failed solve or a loss of measurements."""

    max_reused_ticks: Annotated[int, Field(ge=0, le=100)] = Field(
        5, description="ticks for which the rest of the last valid plan is used after a failed solve [-]"
    )
    max_pose_age: Positive = Field(0.5, description="time without an accepted pose after which the robot brakes [s]")
    dead_reckoning: NotNegative = Field(
        1.5,
        description="age of the last accepted pose up to which wheels and gyro replace poses, if three standard "
        "deviations of the position are within reentry.band; 0: no dead reckoning [s]",
    )
    max_position_error: Positive = Field(
        1.0, description="distance from the reference beyond which the robot brakes and reports it [m]"
    )
    resume: bool = Field(True, description="continue after a stop when poses and solves are valid again [-]")
    resume_within: Positive = Field(
        1.0,
        description="duration of a silence of the base, or of a stop due to missing poses, after which the robot waits "
        "for `start` or `resume` [s]",
    )


Place = Annotated[float, Field(ge=-1e6, le=1e6)]


class Fence(Group):
    """Rectangle around the robot: it brakes before its braking path leaves the rectangle, and waits for `start`."""

    enabled: bool = Field(False, description="brake before the robot leaves the rectangle [-]")
    length: Positive = Field(4.0, description="size of the rectangle along its own heading [m]")
    width: Positive = Field(3.0, description="size of the rectangle across its own heading [m]")
    margin: NotNegative = Field(
        0.1,
        description="minimum distance of the position at rest from the edges, a reserve for model errors [m]",
    )
    frame: Literal["start", "poses"] = Field(
        "start",
        description="frame of the rectangle: that of the start pose of the reference, or that of the poses [-]",
    )
    x: Place = Field(0.0, description="x of the centre of the rectangle in that frame [m]")
    y: Place = Field(0.0, description="y of the centre of the rectangle in that frame [m]")
    heading: Annotated[float, Field(ge=-7, le=7)] = Field(
        0.0, description="direction of its length in that frame, positive to the left [rad]"
    )

    @model_validator(mode="after")
    def _has_room(self) -> Self:
        if 2 * self.margin >= min(self.length, self.width):
            raise ValueError(f"a margin of {self.margin:g} m leaves nothing of {self.length:g} by {self.width:g} m")
        return self


class Reentry(Group):
    """Return of a robot to its path, and waiting of the reference's clock for a lagging robot."""

    # Constants for all robots, with their meaning and unit in fixed_values.yaml.
    heading_wait: ClassVar[float] = fixed_values()["reentry.heading_wait"]
    progress_ramp: ClassVar[float] = fixed_values()["reentry.progress_ramp"]
    min_look_ahead: ClassVar[float] = fixed_values()["reentry.min_look_ahead"]
    window: ClassVar[float] = fixed_values()["reentry.window"]

    enabled: bool = Field(
        True, description="rejoin on a smooth path and let the reference wait; false: track the reference on time [-]"
    )
    band: Positive = Field(0.08, description="distance from the path, to both sides, beyond which it is rejoined [m]")
    heading_band: Positive = Field(0.6, description="heading error beyond which the reference is rejoined [rad]")
    wait: Positive = Field(
        0.1, description="lag along the path at which the reference slows down; at twice this it waits [m]"
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
        0.75, description="share of the hard limits of v and omega for the path back [-]"
    )
    blocked_after: Positive = Field(
        0.5, description="time without motion, while the reference waits, after which the robot counts as blocked [s]"
    )
    blocked_share: Annotated[float, Field(gt=0, le=1)] = Field(
        0.4, description="maximum command to a blocked robot, as a share of the hard limits of v and omega [-]"
    )


class Finish(Group):
    """Conditions for the end of the reference."""

    position: Positive = Field(0.02, description="distance to the end pose [m]")
    speed: Positive = Field(0.02, description="estimated |v| and |omega| below which the robot is at rest [m/s, rad/s]")
    timeout: NotNegative = Field(
        2.0, description="time after the end of the reference at which the drive is finished in any case [s]"
    )


class TermConfig(Group):
    """Function of the user: a residual of the cost, or a value with soft limits; see docs/tuning.md."""

    file: str = Field(min_length=1, description="Python file, relative to the folder of the configuration [-]")
    function: str = Field(min_length=1, description="name of a casadi.Function in that file [-]")
    name: str = Field("", description="name of the term; empty: that of its function [-]")
    kind: Literal["residual", "soft"] = Field(
        "residual", description="residual: half its square is added to the cost; soft: its value is limited [-]"
    )
    upper: list[float | None] | None = Field(
        None, description="soft: upper limits of its value, row by row; null: no limit [its own]"
    )
    lower: list[float | None] | None = Field(
        None, description="soft: lower limits of its value, row by row; null: no limit [its own]"
    )
    parameters: list[float] = Field([], description="initial stage parameters [its own]")


_Schema = TypeVar("_Schema", bound=FeatureGroup)


class ControllerConfig(Group):
    """Configuration of a controller, without the reference.

    Values are read and dumped with the groups of features at the same level as the other groups, by feature name.
    """

    model: str = Field(
        "ssm",
        min_length=1,
        description="velocity model: mbm, sm, ssm, two_delays, lstm, p2_experimental, p2_physical, kinematic "
        "or the path of a model file [-]",
    )
    sample_time: SampleTime = Field(_ROBOT.sample_time, description="time between two ticks [s]")
    horizon: Annotated[int, Field(ge=1, le=200)] = Field(30, description="number of steps of the prediction [-]")
    start_delay: Annotated[float, Field(ge=0, le=10)] = Field(
        0.0, description="rest before the start of a trajectory by name or file [s]"
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
    terms: list[TermConfig] = Field([], description="functions of the user in cost and soft limits [-]")
    features: Mapping[str, SerializeAsAny[FeatureGroup]] = Field(
        {}, description="groups of features by name, written expert.<name> [-]"
    )

    @model_validator(mode="before")
    @classmethod
    def _read_features(cls, data: object) -> object:
        if not isinstance(data, Mapping):
            return data
        groups = {name: data[name] for name in data if name not in cls.model_fields and is_feature(name)}
        stated = data.get("features", {})
        if not isinstance(stated, Mapping) or not (groups or stated):
            return data
        rest = {name: value for name, value in data.items() if name not in groups}
        return rest | {"features": checked_groups({**stated, **groups})}

    @model_serializer(mode="wrap")
    def _dump(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        data: dict[str, Any] = handler(self)
        features: dict[str, Any] = data.pop("features", {})
        return {**data, **features}

    @classmethod
    def further_groups(cls) -> Mapping[str, type[FeatureGroup]]:
        """Return the schemas of installed features by name, for messages and documents."""
        return installed_schemas()

    def feature_group(self, name: str, schema: type[_Schema]) -> _Schema:
        """Return the group of a feature, or the defaults of `schema` if the configuration does not contain it."""
        group = self.features.get(name)
        if group is None:
            return schema()
        assert isinstance(group, schema)
        return group
