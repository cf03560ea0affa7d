"""The mapping file of a log: meaning of columns or topics, with unit and sign."""

from __future__ import annotations

import math
import shlex
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import Field, GetJsonSchemaHandler, field_validator, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.named_file import named_file

TimeUnit = Literal["s", "ms", "us", "ns"]
LengthUnit = Literal["m", "cm", "mm"]
AngleUnit = Literal["rad", "deg"]
SpeedUnit = Literal["m/s", "cm/s", "mm/s", "km/h"]
RateUnit = Literal["rad/s", "deg/s", "mrad/s", "rpm", "rev/s"]
VoltageUnit = Literal["V", "mV"]
CurrentUnit = Literal["A", "mA"]
TWIST_UNITS = (get_args(SpeedUnit), get_args(RateUnit))
POSE_UNITS = (get_args(LengthUnit), get_args(AngleUnit))
"""Units of v and omega, and of a position and a heading; the SI unit is the first."""
WheelUnit = Literal["rad/s", "deg/s", "rpm", "rev/s", "ticks/s", "ticks", "m/s"]

FACTORS: dict[str, float] = {
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "ns": 1e-9,
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "rad": 1.0,
    "deg": math.pi / 180.0,
    "m/s": 1.0,
    "cm/s": 1e-2,
    "mm/s": 1e-3,
    "km/h": 1.0 / 3.6,
    "rad/s": 1.0,
    "deg/s": math.pi / 180.0,
    "mrad/s": 1e-3,
    "rpm": 2.0 * math.pi / 60.0,
    "rev/s": 2.0 * math.pi,
    "V": 1.0,
    "mV": 1e-3,
    "A": 1.0,
    "mA": 1e-3,
}
"""Factor from each unit to SI. Ticks also need the ticks per turn, and rim speeds the wheel radius."""


def draft_command(log: Path) -> str:
    """Return the part of a message that names the command to draft a mapping for a log."""
    return f"drafted by `{shlex.join(['diffdrive-mpc', 'identify', str(log), '--draft-mapping'])}`"


MAPPINGS = Path(__file__).parent / "mappings"

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Delay = Annotated[float, Field(ge=-1, le=1)]
"""Delay [s]; at most that of a sensor in a configuration, and negative for readings that precede their motion."""
Sign = Literal[1, -1]
SIDES = ("left", "right")
FOUR_WHEELS = ("front_left", "front_right", "rear_left", "rear_right")


class _NameOrFields(StrictModel):
    """Model that accepts a plain string as the value of its first field."""

    @model_validator(mode="before")
    @classmethod
    def _expand_plain_name(cls, data: Any) -> Any:  # noqa: ANN401 - content of the file, not yet checked
        return {next(iter(cls.model_fields)): data} if isinstance(data, str) else data

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the schema: a string, or a mapping of the fields."""
        return {"anyOf": [{"type": "string", "minLength": 1}, handler(core)]}


class Column(_NameOrFields):
    """One column; a plain string is the name of a column in SI units."""

    column: str = Field(min_length=1, description="name in the header")


class TimeColumn(Column):
    """A column of times."""

    unit: TimeUnit = "s"
    nanosec: str | None = Field(None, min_length=1, description="column of nanoseconds to add")


class _SignedColumn(Column):
    """Column with an optional inverted sign."""

    unit: str
    sign: Sign = 1


class LengthColumn(_SignedColumn):
    """A column of positions."""

    unit: LengthUnit = "m"


class AngleColumn(_SignedColumn):
    """A column of headings, wrapped or unwrapped."""

    unit: AngleUnit = "rad"


class SpeedColumn(_SignedColumn):
    """A column of forward speeds."""

    unit: SpeedUnit = "m/s"


class RateColumn(_SignedColumn):
    """A column of yaw rates, counter-clockwise positive after `sign`."""

    unit: RateUnit = "rad/s"


class WheelColumn(_SignedColumn):
    """A column of one wheel or side: speed (forward is positive after `sign`) or running count of ticks."""

    unit: WheelUnit = "rad/s"


class VoltageColumn(_SignedColumn):
    """A column of voltages."""

    unit: VoltageUnit = "V"


class CurrentColumn(_SignedColumn):
    """A column of currents; positive after `sign` if the current drives the robot forward or discharges the battery."""

    unit: CurrentUnit = "A"


SignalColumn = LengthColumn | AngleColumn | SpeedColumn | RateColumn | WheelColumn | VoltageColumn | CurrentColumn


class _TwistOrWheels(StrictModel):
    """Columns of (v, omega), or of the wheels of both sides."""

    v: SpeedColumn | None = None
    omega: RateColumn | None = None
    left: WheelColumn | None = None
    right: WheelColumn | None = None

    def has(self, *names: str) -> bool:
        """Return True if the mapping names all fields `names`."""
        return all(getattr(self, name) is not None for name in names)

    @model_validator(mode="after")
    def _check_groups(self) -> Self:
        groups = [("v", "omega"), SIDES, *([FOUR_WHEELS] if hasattr(self, FOUR_WHEELS[0]) else [])]
        for group in groups:
            present = [name for name in group if self.has(name)]
            if present and len(present) < len(group):
                missing = next(name for name in group if name not in present)
                raise ValueError(f"'{present[0]}' also needs '{missing}'")
        for first, second in (("v", "omega"), SIDES, FOUR_WHEELS[:2], FOUR_WHEELS[2:]):
            columns = [part.column for name, part in self if name in (first, second) and part is not None]
            if len(columns) > len(set(columns)):
                raise ValueError(f"column '{columns[0]}' is named for '{first}' and for '{second}'; correct one")
        if not any(self.has(*group) for group in groups):
            raise ValueError(f"name the columns of {' or of '.join(', '.join(group) for group in groups)}")
        return self


class CommandColumns(_TwistOrWheels):
    """Columns of the command: (v, omega), or wheel speeds left and right. An empty cell keeps the last command."""

    delay: Delay = Field(0.0, description="delay of the logged time of a command after the robot received it [s]")

    @model_validator(mode="after")
    def _check_units(self) -> Self:
        if self.has("v") and self.has("left"):
            raise ValueError("name the columns of v and omega, or of left and right, not both")
        for side in (self.left, self.right):
            if side is not None and side.unit == "ticks":
                raise ValueError("a command is a speed: give 'ticks/s', not 'ticks'")
        return self


class SensorColumns(StrictModel):
    """Columns of a sensor, with its delay and time."""

    time: TimeColumn | None = Field(
        None, description="times of the readings, if they differ from the times of the rows"
    )
    held: bool = Field(False, description="rows repeat the last reading until the next one arrives")
    delay: Delay = Field(0.0, description="delay of the logged time of a reading after the measurement [s]")


class EncoderColumns(_TwistOrWheels, SensorColumns):
    """Columns of the encoders: (v, omega), both sides, four wheels, or several of these groups."""

    front_left: WheelColumn | None = None
    front_right: WheelColumn | None = None
    rear_left: WheelColumn | None = None
    rear_right: WheelColumn | None = None


class GyroColumns(SensorColumns):
    """Columns of the gyro."""

    yaw_rate: RateColumn


class PoseColumns(SensorColumns):
    """Columns of the robot's pose in one frame per segment; the source must be more accurate than the encoders."""

    x: LengthColumn
    y: LengthColumn
    theta: AngleColumn | None = Field(None, description="heading; if it is missing, it is computed from x and y")
    heading_offset: Annotated[float, Field(ge=-4, le=4)] = Field(
        0.0, description="offset of theta from the robot's heading, counter-clockwise [rad]"
    )


class PowerColumns(SensorColumns):
    """Columns of battery or motors."""

    optional: bool = Field(False, description="accept logs that lack these columns, and ignore the entry")


class BatteryColumns(PowerColumns):
    """Columns of the battery."""

    voltage: VoltageColumn
    current: CurrentColumn


class MotorColumns(PowerColumns):
    """Columns of the motor currents: the total of each side, or the current of each of four motors."""

    left: CurrentColumn | None = None
    right: CurrentColumn | None = None
    front_left: CurrentColumn | None = None
    front_right: CurrentColumn | None = None
    rear_left: CurrentColumn | None = None
    rear_right: CurrentColumn | None = None

    @property
    def named_columns(self) -> tuple[str, ...]:
        """Names of the fields that are set."""
        return tuple(name for name in (*SIDES, *FOUR_WHEELS) if getattr(self, name) is not None)

    @model_validator(mode="after")
    def _check_groups(self) -> Self:
        if self.named_columns not in (SIDES, FOUR_WHEELS):
            raise ValueError(f"name the columns of {', '.join(SIDES)}, or of {', '.join(FOUR_WHEELS)}")
        return self


class Columns(StrictModel):
    """The columns of a CSV file."""

    time: TimeColumn | None = Field(None, description="times of the rows")
    sample_time: Positive | None = Field(None, description="time between rows [s], for a log without time stamps")
    segment: str | None = Field(None, description="column; each change of its value starts a new stretch")
    where: dict[str, str | float | tuple[str | float, ...]] = Field(
        default_factory=dict, description="required value, or allowed values, by column; other rows are skipped"
    )
    command: CommandColumns
    encoders: EncoderColumns | None = None
    gyro: GyroColumns | None = None
    pose: PoseColumns | None = None
    battery: BatteryColumns | None = Field(None, description="columns of the battery; used for the energy model only")
    motors: MotorColumns | None = Field(None, description="columns of the motor currents; used for torques only")

    @model_validator(mode="after")
    def _check_time_and_sensors(self) -> Self:
        if (self.time is None) == (self.sample_time is None):
            raise ValueError(
                "give either 'time', the column of times, or 'sample_time' [s] for a log without time stamps"
            )
        if self.encoders is None and self.gyro is None and self.pose is None:
            raise ValueError("no sensor is mapped: name the columns of 'encoders', 'gyro' or 'pose'")
        return self

    def without_absent_sensors(self, recorded: Collection[str]) -> Self:
        """Remove optional sensors unless all their columns are in `recorded`."""
        missing = [
            key
            for key, group in (("battery", self.battery), ("motors", self.motors))
            if group is not None
            and group.optional
            and not {part.column for _, part in group if isinstance(part, Column)} <= set(recorded)
        ]
        return self.model_copy(update=dict.fromkeys(missing))

    def column_names(self) -> set[str]:
        """Return the names of all columns that the mapping uses."""
        groups = [self.command, self.encoders, self.gyro, self.pose, self.battery, self.motors]
        parts = [part for group in groups if group is not None for _, part in group]
        names = {part.column for part in [self.time, *parts] if isinstance(part, Column)}
        times = [self.time, *(part for part in parts if isinstance(part, TimeColumn))]
        names |= {part.nanosec for part in times if part is not None and part.nanosec}
        return names | set(self.where) | ({self.segment} if self.segment else set())


class Topic(_NameOrFields):
    """One topic of a bag; a plain string is the name of a topic with sign 1 and no delay."""

    topic: str = Field(min_length=1)
    sign: Sign = Field(1, description="factor of yaw rates, headings and currents; -1 for a sensor mounted upside down")
    delay: Delay = Field(0.0, description="delay of the stamps after the measurement [s]")
    fields: tuple[str, ...] | None = Field(
        None, description="fields of the values if the message type is not supported, such as twist.linear.x or data.0"
    )
    on_change: bool = Field(
        False, description="true for commands that are sent only when they change; each holds until the next"
    )


class MotorTopic(Topic):
    """Topic of the motor currents of one side.

    The current of the side is the sum of all values. A plain string is the name of a topic of std_msgs Float32 or
    Float64.
    """

    joints: tuple[str, ...] | None = Field(
        None, description="joints of sensor_msgs JointState with the motor currents of this side in `effort`"
    )
    unit: CurrentUnit = "A"

    @model_validator(mode="after")
    def _check_source(self) -> Self:
        if self.joints is not None and self.fields is not None:
            raise ValueError("give 'joints' or 'fields', not both")
        return self


class MotorTopics(StrictModel):
    """Topics of the motor currents of both sides, which may be the same topic."""

    left: MotorTopic
    right: MotorTopic


class Topics(StrictModel):
    """The topics of a bag. If no sensor is named, /odom and /imu are used if present."""

    command: Topic = Field(Topic(topic="/cmd_vel"), description="geometry_msgs Twist or TwistStamped")
    odometry: Topic | None = Field(None, description="nav_msgs Odometry of the encoders alone; its twist is used")
    imu: Topic | None = Field(None, description="sensor_msgs Imu, read about the vertical of /tf_static, else z")
    pose: Topic | None = Field(
        None, description="PoseStamped, PoseWithCovarianceStamped or Odometry of a localisation, not of the encoders"
    )
    battery: Topic | None = Field(
        None, description="sensor_msgs BatteryState with negative current while discharging; else give sign: -1"
    )
    motors: MotorTopics | None = Field(None, description="currents of the motors, positive when they drive forward")
    clock: Literal["stamp", "receive"] = Field(
        "stamp", description="source of the times: stamps of the messages, or receive times of the recorder"
    )
    definitions: dict[str, str] = Field(
        default_factory=dict, description="files of message definitions, relative to the mapping, by type: pkg/msg/Name"
    )

    def resolve(self, recorded: Collection[str]) -> Self:
        """Add the recorded ones of /odom and /imu if no sensor is named; otherwise resolve namespaces."""
        if self.odometry or self.imu or self.pose:
            return self._in_namespace(recorded)
        defaults = {"odometry": "/odom", "imu": "/imu"}
        return self.model_copy(update={role: Topic(topic=name) for role, name in defaults.items() if name in recorded})

    def _in_namespace(self, recorded: Collection[str]) -> Self:
        """Resolve relative names in the only recorded namespace with the odometry topic; keep absolute names.

        Raises
        ------
        models.checked_yaml.ConfigError
            If no namespace or several namespaces have the odometry topic.
        """
        if self.odometry is None or self.odometry.topic.startswith("/"):
            return self
        suffix = f"/{self.odometry.topic}"
        namespaces = sorted(name.removesuffix(suffix) for name in recorded if name.endswith(suffix))
        if len(namespaces) != 1:
            reason = f"several namespaces have it: {', '.join(namespaces)}" if namespaces else "no namespace has it"
            remedy = f"give a mapping file; the bag has {', '.join(sorted(recorded))}"
            raise ConfigError(f"topic '{self.odometry.topic}' of the robot: {reason}; {remedy}")
        resolved: dict[str, Topic | None] = {}
        for role in ("command", "odometry", "imu"):
            topic: Topic | None = getattr(self, role)
            if topic is not None and not topic.topic.startswith("/"):
                name = f"{namespaces[0]}/{topic.topic}"
                # The gyro is optional in a bag; command and odometry are required, and their absence is reported later.
                is_missing = role == "imu" and name not in recorded
                resolved[role] = None if is_missing else topic.model_copy(update={"topic": name})
        return self.model_copy(update=resolved)


class MappedWheels(StrictModel):
    """Parameters of the wheels that convert wheel speeds to (v, omega)."""

    radius: Positive | None = Field(None, le=3.0, description="wheel radius, needed for columns of wheels [m]")
    track: Positive = Field(le=10.0, description="track [m]")
    ticks_per_turn: Positive | None = Field(None, description="encoder ticks per turn of the wheel")

    @field_validator("radius", "ticks_per_turn", mode="before")
    @classmethod
    def _refuse_empty(cls, value: object) -> object:
        """Refuse a key without a value, as in a draft, which would be equal to a missing key."""
        if value is None:
            raise ValueError("fill in a number, or remove the key if no column is a wheel speed or in ticks")
        return value


class LogMapping(StrictModel):
    """A mapping file."""

    source: str = Field("", description="origin of the log, and basis of the signs and delays")
    columns: Columns | None = None
    topics: Topics | None = None
    wheels: MappedWheels | None = None
    times: tuple[tuple[float, float], ...] = Field(
        (), description="start and end of each part to use, on the log's clock [s]; empty for the whole log"
    )
    gap: Positive | None = Field(None, description="maximum time between two commands or rows of one stretch [s]")

    @field_validator("times")
    @classmethod
    def _check_times(cls, times: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        for start, end in times:
            if not start < end:
                raise ValueError(f"the part from {start:g} to {end:g} s is empty; give the start before the end")
        return times

    def unused_entries(self) -> list[str]:
        """List entries of the mapping that have no effect, one sentence each."""
        groups = (self.columns.command, self.columns.encoders) if self.columns else ()
        columns = [part for group in groups if group is not None for _, part in group if isinstance(part, WheelColumn)]
        motors = self.topics is not None and self.topics.motors is not None
        lines = []
        # Bags with motor topics use the radius to compute wheel speeds from the odometry.
        if self.wheels is not None and self.wheels.radius is not None and not (columns or motors):
            lines.append("wheels.radius is not used: no column in the mapping is the speed of a wheel")
        if (
            self.wheels is not None
            and self.wheels.ticks_per_turn
            and not any("ticks" in column.unit for column in columns)
        ):
            lines.append("wheels.ticks_per_turn is not used: no column has the unit ticks or ticks/s")
        for role, topic in self.topics or ():
            if isinstance(topic, Topic) and topic.on_change and role != "command":
                lines.append(f"topics.{role}.on_change is not used: it applies to commands only")
        if self.topics is not None and self.topics.command.sign != 1:
            lines.append("topics.command.sign is not used: only yaw rates, headings and currents have a sign")
        return lines

    def sources(self) -> dict[str, str]:
        """Return the columns or topics of each stream: "command", "encoders", "gyro", "pose", "battery"."""
        sources: dict[str, str] = {}
        for group in (self.columns, self.topics):
            for role, part in group or ():
                name = {"odometry": "encoders", "imu": "gyro"}.get(role, role)
                if isinstance(part, Topic):
                    sources[name] = part.topic
                elif part is not None and name in ("command", "encoders", "gyro", "pose"):
                    sources[name] = ", ".join(column.column for key, column in part if isinstance(column, SignalColumn))
        return sources


def load_mapping(name: str | Path) -> LogMapping:
    """Read a mapping file.

    Parameters
    ----------
    name
        Name of a shipped mapping ("simulate", "husky_tile", ...) or the path of a YAML file.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is no such mapping or it is invalid.
    """
    path = named_file("mapping", MAPPINGS, name)
    mapping = load_checked(LogMapping, path)
    if mapping.topics is not None and mapping.topics.definitions:
        paths = {kind: str(path.parent / file) for kind, file in mapping.topics.definitions.items()}
        return mapping.model_copy(update={"topics": mapping.topics.model_copy(update={"definitions": paths})})
    return mapping
