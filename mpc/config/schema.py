"""The configuration of a controller: one typed schema with unit, range and help for every field.

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

# Limits and sample time default to those of the shipped robot file.
_ROBOT = load_robot()


class ExtraDeadTime(Group):
    """Dead time of the robot at hand that the model file does not carry."""

    v: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="added to the forward channel [s]")
    omega: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="added to the yaw channel [s]")
    provenance: str = Field("", description="how the values were found")


class Weights(Group):
    """Weights of the quadratic cost, each summed over the steps of the horizon."""

    along: NotNegative = Field(350.0, description="squared position error along the path [1/m^2]")
    across: NotNegative = Field(700.0, description="squared position error across the path [1/m^2]")
    heading: NotNegative = Field(30.0, description="squared heading error, side-slip allowed for [1/rad^2]")
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
        50.0, description="exact penalty on each unit by which a soft limit is exceeded [1/(m/s), 1/(rad/s), 1/m]"
    )
    soft_quadratic: Positive = Field(50.0, description="quadratic penalty beside it [1/(m/s)^2, 1/(rad/s)^2, 1/m^2]")


class Margin(Group):
    """Delay beyond the model's that the closed loop tolerates; see docs/tuning.md."""

    # Lightest weights tolerate 0.24 to 0.26 s and 0.107 to 0.124 s (SM, MBM, SSM); slower robots need heavier ones.
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
        description="hard: rate of change of v_ref while driving; a number, or {accelerate, brake} for |v_ref| that "
        "grows and falls [m/s^2]",
    )
    omega_slew: Annotated[SlewLimit, Field(gt=0)] = Field(
        SlewLimit(_ROBOT.command_slew.omega),
        description="hard: rate of change of omega_ref while driving; a number, or {accelerate, brake} for |omega_ref| "
        "that grows and falls [rad/s^2]",
    )
    v_braking: Annotated[float, Field(ge=0.2)] = Field(
        _ROBOT.command_slew.v,
        description="hard: rate at which v_ref goes to zero in BRAKING and FINISHED, whatever v_slew says [m/s^2]",
    )
    omega_braking: Annotated[float, Field(ge=0.5)] = Field(
        _ROBOT.command_slew.omega,
        description="hard: rate at which omega_ref goes to zero in BRAKING and FINISHED, whatever omega_slew says "
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
        description="soft: |omega| times this is no more than |v|, for a robot that must not turn on the spot; without "
        "it any turn will do [m]",
    )
    min_commanded_radius: Positive | None = Field(
        None,
        description="hard within what slew allows: |omega_ref| times this is no more than |v_ref|, for motors that "
        "have no torque for tighter turns; sharper corners of a path are cut [m]",
    )
    corridor: Positive = Field(0.5, description="soft: predicted distance from the path to either side [m]")

    @property
    def min_path_radius(self) -> float:
        """Paths that are laid here turn no tighter [m]; 0: they may turn on the spot."""
        return max(self.min_turn_radius or 0.0, self.min_commanded_radius or 0.0)


class Wheels(Group):
    """Wheel geometry, which relates a twist to wheel speeds."""

    track: Annotated[float, Field(gt=0, le=10)] = Field(
        0.4,
        description="track by which the robot's firmware turns a yaw rate into wheel speeds; on a skid-steer it is "
        "wider than the geometric one [m]",
    )
    encoder_track: Positive = Field(
        _ROBOT.track, description="track by which the encoders' yaw rate was computed, the geometric one [m]"
    )


def _turned(sign: int) -> int:
    if not sign:
        raise ValueError("it is 1, or -1 for a sensor that reads the other way round")
    return sign


Sign = Annotated[int, Field(ge=-1, le=1), AfterValidator(_turned)]


class SensorResponse(Group):
    """Properties of every sensor."""

    delay: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="a reading is so much older than its stamp [s]")


class PoseResponse(SensorResponse):
    """Properties of poses."""

    heading: Annotated[float, Field(ge=-4, le=4)] = Field(
        0.0, description="angle by which the heading of poses is ahead of the robot's [rad]"
    )


class SpeedResponse(SensorResponse):
    """Properties of a sensor of speed."""

    lag: Annotated[float, Field(ge=0, le=1)] = Field(
        0.0, description="by which its own filter trails what it measures: time constants, all added [s]"
    )
    scale: Annotated[float, Field(ge=0.01, le=100)] = Field(1.0, description="size of a reading over what is [-]")

    @property
    def late(self) -> float:
        """Return delay and lag together [s]: for slow motion, a lag acts like a delay of the same size."""
        return self.delay + self.lag


class WheelResponse(SpeedResponse):
    """Properties of the encoders."""

    sign: Sign = Field(1, description="-1 where forward reads backward [-]")
    turn_sign: Sign = Field(
        1, description="-1 where a turn to the left reads to the right, as with sides exchanged [-]"
    )


class YawRateResponse(SpeedResponse):
    """Properties of a gyro."""

    sign: Sign = Field(1, description="-1 for one that is mounted upside down [-]")


class SensorResponses(Group):
    """Differences between the readings of sensors and the motion at their stamps."""

    wheels: WheelResponse = WheelResponse()
    yaw_rate: YawRateResponse = YawRateResponse()
    pose: PoseResponse = PoseResponse()


class Compensation(Group):
    """Effects that the controller compensates. Use all of them in practice; disabling one shows its benefit."""

    dead_time: bool = Field(True, description="predict over the dead time of model file and extra_dead_time [-]")
    delay: bool = Field(True, description="estimate delays of the commands that the model lacks [-]")
    v_offset: bool = Field(True, description="estimate forward speed that the model does not explain [-]")
    yaw_gain: bool = Field(True, description="estimate how much the robot turns for what is commanded [-]")
    side_slip: bool = Field(True, description="estimate side-slip and turning point [-]")


_FLAT = [0.0, 0.0, 0.0]


def _checked_slip(values: list[float]) -> list[float]:
    start, *deviations = values
    if not (abs(start) <= 2 and min(deviations) >= 0):
        raise ValueError("give [start from -2 to 2, standard deviation of it, random walk of it per sqrt(s)]")
    return values


CurvedSlip = Annotated[list[float], Field(min_length=3, max_length=3), AfterValidator(_checked_slip)]
"""Start, standard deviation there and random walk per sqrt(s) of a slip that curves the twist."""


class Estimator(Group):
    """Noise assumed by the Kalman filter (standard deviations), and thresholds for rejecting measurements.

    Slips that curve the twist are lists of their start, its standard deviation, and its random walk per sqrt(s).
    """

    # Constants that no robot has to change, with their meaning and unit in fixed_values.yaml.
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
    position_noise: Positive = Field(0.005, description="position, where the pose states no covariance [m]")
    heading_noise: Positive = Field(0.0052, description="heading, where the pose states no covariance [rad]")
    v_input_noise: Positive = Field(0.05, description="what the model gets wrong, as noise on v_ref [m/s]")
    omega_input_noise: Positive = Field(0.1, description="what the model gets wrong, as noise on omega_ref [rad/s]")
    v_offset_drift: Positive = Field(0.02, description="random walk of the v offset [m/s per sqrt(s)]")
    omega_gain_drift: Positive = Field(0.01, description="random walk of that gain [1 per sqrt(s)]")
    longitudinal_gain_uncertainty: Positive = Field(0.01, description="speed of body over wheels, at the start [-]")
    longitudinal_gain_drift: Positive = Field(0.002, description="random walk of that gain [1 per sqrt(s)]")
    yaw_gain_drift: Positive = Field(0.015, description="random walk of that gain [1 per sqrt(s)]")
    side_slip: NotNegative = Field(0.0, description="lateral speed, outward, over v omega, at the start [s]")
    side_slip_uncertainty: Positive = Field(0.05, description="lateral speed over v omega, at the start [s]")
    side_slip_drift: Positive = Field(0.02, description="random walk of the side-slip [s per sqrt(s)]")
    turn_ahead_drift: NotNegative = Field(
        0.01, description="random walk of the turning point, ahead of the origin [m per sqrt(s)]"
    )
    turn_left_drift: NotNegative = Field(0.01, description="the same to the left of the origin [m per sqrt(s)]")
    load_shift: NotNegative = Field(
        0.0, description="how far back the turning point moves for an acceleration, at the start [s^2]"
    )
    load_shift_drift: NotNegative = Field(0.001, description="random walk of that shift [s^2 per sqrt(s)]")
    slide_drift: NotNegative = Field(
        0.001, description="random walk of the slide for each radian turned [m/rad per sqrt(s)]"
    )
    crab: CurvedSlip = Field(_FLAT, description="lateral speed, to the left, over forward speed [-]")
    veer: CurvedSlip = Field(_FLAT, description="yaw for each metre that the wheels drive [rad/m]")
    forward_coupling: CurvedSlip = Field(
        _FLAT, description="forward speed over product of the wheels' speed and yaw rate [s/rad]"
    )
    yaw_coupling: CurvedSlip = Field(_FLAT, description="yaw rate over product of the wheels' speed and yaw rate [s/m]")
    track_growth: CurvedSlip = Field(
        _FLAT, description="share by which the track widens for each rad/s of yaw rate [s/rad]"
    )
    lasting_surprise: Positive = Field(0.6, description="a longer surprise is slip, and is learned from [s]")
    history: Annotated[float, Field(ge=0.05, le=5)] = Field(
        0.4, description="how late a pose may arrive and still be applied at its stamp [s]"
    )
    max_wheel_speed: Positive = Field(
        5.0, description="a forward speed from the encoders beyond this is rejected [m/s]"
    )
    max_yaw_rate: Positive = Field(10.0, description="a yaw rate of the gyro beyond this is rejected [rad/s]")
    max_position_jump: Positive = Field(0.3, description="a pose further than this from the prediction is rejected [m]")
    max_heading_jump: Positive = Field(
        0.6, description="a pose turned by more than this from the prediction is rejected [rad]"
    )

    def start(self, slip: str) -> float:
        """Return the value of a slip that curves the twist at the start of a drive."""
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

    enabled: bool = Field(True, description="find the sensor that the others contradict, and do without it [-]")
    false_alarm_rate: Annotated[float, Field(gt=0, le=1000)] = Field(
        0.02, description="how often a sensor may be given up while all of them are honest [1/h]"
    )
    turn_ratio: Annotated[float, Field(gt=1)] = Field(
        1.6, description="wheels or body turning by more than this factor beside what the tracks say is told [-]"
    )
    trust_after: Positive = Field(
        1.0, description="a sensor that has agreed again for so long, while the robot moved, is believed again [s]"
    )
    wheel_limits: bool = Field(
        True, description="learn the speed at which wheels fall short, and slow the reference down to it [-]"
    )


class Failure(Group):
    """Behaviour after a failed solve or a loss of measurements."""

    max_reused_ticks: Annotated[int, Field(ge=0, le=100)] = Field(
        5, description="ticks for which the rest of the last good plan is used after a failed solve [-]"
    )
    max_pose_age: Positive = Field(0.5, description="without an accepted pose for longer, the robot brakes [s]")
    dead_reckoning: NotNegative = Field(
        1.5,
        description="wheels and gyro stand in for poses until the last accepted one is this old, while three standard "
        "deviations of the position are inside reentry.band; 0: never [s]",
    )
    max_position_error: Positive = Field(
        1.0, description="further than this from where the reference is, the robot brakes and says so [m]"
    )
    resume: bool = Field(True, description="drive on when poses and solves are good again after a stop [-]")
    resume_within: Positive = Field(
        1.0,
        description="after a silence of the base, or a stop for want of poses, that lasted longer, the robot waits for "
        "`start` or `resume` [s]",
    )


Place = Annotated[float, Field(ge=-1e6, le=1e6)]


class Fence(Group):
    """A rectangle that the robot stays in: before its braking path leaves it, it brakes, and stands until `start`."""

    enabled: bool = Field(False, description="brake before the robot leaves the rectangle [-]")
    length: Positive = Field(4.0, description="size of the rectangle along its own heading [m]")
    width: Positive = Field(3.0, description="size of the rectangle across its own heading [m]")
    margin: NotNegative = Field(
        0.1,
        description="so far inside the rectangle the robot is to come to rest, for what the model does not know [m]",
    )
    frame: Literal["start", "poses"] = Field(
        "start",
        description="start: the rectangle lies as seen from where the reference begins; poses: in the frame of the "
        "poses [-]",
    )
    x: Place = Field(0.0, description="middle of the rectangle along that frame [m]")
    y: Place = Field(0.0, description="middle of the rectangle to the left in that frame [m]")
    heading: Annotated[float, Field(ge=-7, le=7)] = Field(
        0.0, description="direction of its length in that frame, turned to the left [rad]"
    )

    @model_validator(mode="after")
    def _has_room(self) -> Self:
        if 2 * self.margin >= min(self.length, self.width):
            raise ValueError(f"a margin of {self.margin:g} m leaves nothing of {self.length:g} by {self.width:g} m")
        return self


class Reentry(Group):
    """Return of a robot to its path, and waiting of the reference clock for a robot that is late."""

    # Constants that no robot has to change, with their meaning and unit in fixed_values.yaml.
    heading_wait: ClassVar[float] = fixed_values()["reentry.heading_wait"]
    progress_ramp: ClassVar[float] = fixed_values()["reentry.progress_ramp"]
    min_look_ahead: ClassVar[float] = fixed_values()["reentry.min_look_ahead"]
    window: ClassVar[float] = fixed_values()["reentry.window"]

    enabled: bool = Field(True, description="rejoin on a smooth path and let the reference wait; false: chase it [-]")
    band: Positive = Field(0.08, description="further than this from the path to either side, it is rejoined [m]")
    heading_band: Positive = Field(0.6, description="turned by more than this from the reference, it is rejoined [rad]")
    wait: Positive = Field(
        0.1, description="lag along the path from which the reference slows down; at twice this it stands [m]"
    )
    max_progress: Annotated[float, Field(gt=1, le=2)] = Field(
        1.25, description="fastest rate of the reference's clock while it catches up, and of driving back to it [-]"
    )
    max_look_ahead: Positive = Field(2.0, description="largest distance along the path to where it is rejoined [m]")
    v_acceleration: Positive = Field(
        _ROBOT.reference_acceleration.v, description="largest forward acceleration of the way back [m/s^2]"
    )
    omega_acceleration: Positive = Field(
        _ROBOT.reference_acceleration.omega, description="largest yaw acceleration of the way back [rad/s^2]"
    )
    effort: Annotated[float, Field(gt=0, le=1)] = Field(
        0.75, description="share of the hard limits of v and omega that the way back may use [-]"
    )
    blocked_after: Positive = Field(
        0.5, description="a robot that does not move for so long while the reference waits is blocked [s]"
    )
    blocked_share: Annotated[float, Field(gt=0, le=1)] = Field(
        0.4, description="share of the hard limits of v and omega that a blocked robot is asked for at most [-]"
    )


class Finish(Group):
    """When the end of the reference counts as reached."""

    position: Positive = Field(0.02, description="distance to the end pose [m]")
    speed: Positive = Field(0.02, description="estimated |v| and |omega| below which the robot is at rest [m/s, rad/s]")
    timeout: NotNegative = Field(
        2.0, description="time after the end of the reference at which it is finished anyway [s]"
    )


class TermConfig(Group):
    """A function of the user: a residual of the cost, or something with soft limits; see docs/tuning.md."""

    file: str = Field(min_length=1, description="Python file that defines it, from the folder of the configuration [-]")
    function: str = Field(min_length=1, description="name of a casadi.Function in that file [-]")
    name: str = Field("", description="what the term is called; empty: as its function [-]")
    kind: Literal["residual", "soft"] = Field(
        "residual", description="residual: half its square is added to the cost; soft: its value is limited [-]"
    )
    upper: list[float | None] | None = Field(
        None, description="soft: upper limits of its value, row by row; null: no limit [its own]"
    )
    lower: list[float | None] | None = Field(
        None, description="soft: lower limits of its value, row by row; null: no limit [its own]"
    )
    parameters: list[float] = Field([], description="stage parameters until others are set [its own]")


_Schema = TypeVar("_Schema", bound=FeatureGroup)


class ControllerConfig(Group):
    """Configuration of a controller, apart from the reference.

    Values are read and dumped with the groups of features next to the other groups, each under the feature's name.
    """

    model: str = Field(
        "ssm",
        min_length=1,
        description="velocity model: mbm, sm, ssm, two_delays, lstm, p2_experimental, p2_physical, kinematic "
        "or the path of a model file [-]",
    )
    sample_time: SampleTime = Field(_ROBOT.sample_time, description="time between two ticks [s]")
    horizon: Annotated[int, Field(ge=1, le=200)] = Field(30, description="steps that the controller looks ahead [-]")
    start_delay: Annotated[float, Field(ge=0, le=10)] = Field(
        0.0, description="rest before a trajectory by name or file, in which the robot prepares its start [s]"
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
        """Return the schemas of installed features by name, for messages and documentation."""
        return installed_schemas()

    def feature_group(self, name: str, schema: type[_Schema]) -> _Schema:
        """Return the group of a feature, or the defaults of `schema` if the configuration does not name it."""
        group = self.features.get(name)
        if group is None:
            return schema()
        assert isinstance(group, schema)
        return group
