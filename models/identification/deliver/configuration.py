"""Controller configuration for the identified robot, with a reason for each value.

Only this module writes `config.yaml`. Values are positive and rounded as in the file. Values that a log cannot
determine keep the schema's default, and a comment lists them.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.models.base_effects import WheelCommand
from diffdrive_mpc.models.identification.fit.noise import sensor_noise
from diffdrive_mpc.models.identification.fit.slip import SlipPrior
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.geometry import WheelGeometry, firmware_track
from diffdrive_mpc.models.logs.record import Record, Topics
from diffdrive_mpc.models.output_error.input_limits import limits_in
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.models.stated_robot import ManufacturerRobot, StatedKey
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.table import plain_line
from diffdrive_mpc.models.two_sided import SlewLimit, TwoSided, VelocityLimit, YawRateLimit, sides_of
from diffdrive_mpc.models.velocity_model import CHANNELS, VelocityModel

# Parameters of the ROS node for the robot of a bag: topics and message types.


NODE_FILE = "node.yaml"
_NODE_NAMES = {"command": "cmd_vel", "odometry": "odom", "imu": "imu", "pose": "pose"}
_TYPES = {
    "command": ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"),
    "odometry": ("nav_msgs/msg/Odometry",),
    "imu": ("sensor_msgs/msg/Imu",),
    "pose": ("geometry_msgs/msg/PoseWithCovarianceStamped",),
}


def node_arguments(topics: Topics, folder: Path = Path()) -> str:
    """Format the arguments of `diffdrive-mpc node` for the topics, with the parameters file in `folder`."""
    arguments = ["--ros-args", "--params-file", str(folder / NODE_FILE)]
    for role, name in _NODE_NAMES.items():
        topic, message_type = topics.get(role, (f"/{name}", ""))
        if message_type in _TYPES[role] and topic != f"/{name}":
            arguments += ["-r", f"{name}:={topic}"]
    return shlex.join(arguments)


def node_text(topics: Topics) -> str:
    """Format the parameters file with the source of each value, and list the topics that the node cannot read.

    A parameters file cannot contain topic remappings; its first line is a comment with the command that remaps.
    """
    readable_topics = {
        role: topic_and_type
        for role, topic_and_type in topics.items()
        if role in _TYPES and topic_and_type[1] in _TYPES[role]
    }
    values = {
        "stamped": ("command", str("TwistStamped" in readable_topics.get("command", ("", "TwistStamped"))[1]).lower()),
        "use_imu": ("imu", str("imu" in readable_topics).lower()),
        "pose_source": ("pose", "topic" if "pose" in readable_topics else "odometry"),
    }
    command = "diffdrive-mpc node --config config.yaml --trajectory first_circle.yaml --autostart"
    lines = [f"# {command} {node_arguments(topics)}", "/**:", "  ros__parameters:"]
    lines += [f"    {name}: {value}{_topic_comment(topics, role)}" for name, (role, value) in values.items()]
    for role, (topic, message_type) in topics.items():
        if role in _TYPES and role not in readable_topics:
            expected = " or ".join(_TYPES[role])
            lines.append(f"    # {topic} carries {message_type}, which the node cannot read as {role}; use {expected}")
    return "\n".join(lines) + "\n"


def _topic_comment(topics: Topics, role: str) -> str:
    return "   # {} carries {}".format(*topics[role]) if role in topics else f"   # the log has no {role}"


# Period and horizon of the controller of an identified robot.


_SAMPLES = 2000
_PERIOD_TOLERANCE = 1e-4
"""Relative difference below which two periods are equal [-]."""


@dataclass(frozen=True)
class Pace:
    """Period and horizon of the controller.

    Attributes
    ----------
    sample_time
        Time between two commands [s].
    log_samples
        Time between two commands, in samples of the log.
    horizon
        Prediction horizon [steps].
    settling
        Settling time of the slower channel after a command step, including dead time [s].
    """

    sample_time: float
    log_samples: int
    horizon: int
    settling: float


def settling_time(model: VelocityModel) -> float:
    """Compute the settling time of the slower channel after a command step, including dead time [s].

    The tolerance is the share `settling_tolerance` of the steady-state value (see `settings.yaml`). The settling time
    of a model without lag and dead time is 0.
    """
    share = identification_settings().settling_tolerance
    # After seven time constants, the response of the slowest pole has decayed to a thousandth.
    max_time_constant = max((-1.0 / pole.real for pole in model.poles), default=0.0)
    duration = float(np.max(model.dead_time)) + 7.0 * max_time_constant
    if not duration > 0.0:
        return 0.0
    dt = duration / _SAMPLES
    settling = 0.0
    for row, step in enumerate(np.eye(2)):
        response = model.discretise(dt).simulate(np.tile(step, (_SAMPLES, 1)))[:, row]
        gain = model.dc_gain[row, row]
        (samples,) = np.nonzero(np.abs(response - gain) > share * abs(gain))
        settling = max(settling, dt * (samples[-1] + 1) if samples.size else 0.0)
    return settling


def round_period(dt: float) -> float:
    """Round the sample time `dt` [s] to the shortest decimal number within 0.01 % [s].

    Because of jitter of the stamps, the median step of a log may be 0.0500001 s for a period of 0.05 s.
    """
    candidates = (float(f"{dt:.{digits}g}") for digits in range(1, 17))
    return next((period for period in candidates if abs(period - dt) <= _PERIOD_TOLERANCE * dt), dt)


def choose_pace(model: VelocityModel, dt: float) -> Pace:
    """Choose period and horizon that cover the robot's step response, for a log with sample time `dt` [s].

    For a robot that is slow relative to `dt`, the period is several samples, so that the horizon does not exceed the
    maximum number of steps.
    """
    settings, settling = identification_settings(), settling_time(model)
    prediction_time = settings.look_ahead * settling
    log_samples = max(1, math.ceil(prediction_time / (settings.max_steps * dt) - 1e-9))
    horizon = max(settings.min_steps, math.ceil(prediction_time / (log_samples * dt) - 1e-9))
    return Pace(log_samples * dt, log_samples, horizon, settling)


MODEL_FILE, CONFIG_FILE = "model.yaml", "config.yaml"
_UNITS = {"v": "m/s", "omega": "rad/s"}
_KINDS = {"v": VelocityLimit, "omega": YawRateLimit}
_NOISE_UNITS = {
    "wheel_speed_noise": "m/s",
    "wheel_yaw_rate_noise": "rad/s",
    "yaw_rate_noise": "rad/s",
    "position_noise": "m",
    "heading_noise": "rad",
}
_UNKNOWN_SLEW = "# a log does not determine v_slew and omega_slew: set them for gentler driving"
_SENSORS = "from the log and its mapping; the robot's node reads the sensor without the mapping"
_GROUPS = "limits", "wheels", "estimator", "reentry", "failure", "free_space"
_FAST_PERCENTILE, _REACHED_SHARE = 90.0, 0.85
"""Percentile [%] of the fastest commands of a side, and share of them that a robot without a speed limit reaches."""
_TRACK_TOLERANCE = 0.01
"""Relative difference below which two tracks are equal [-]."""
_UNKNOWN_WHEELS = (
    "# The log does not determine wheels.track and wheels.encoder_track, which keep the default; set them, and "
    "limits.wheel_speed."
)


@dataclass(frozen=True)
class Setting:
    """Value of the configuration with a reason.

    Attributes
    ----------
    name
        Key in the group.
    value
        Positive number, rounded to the digits of the file; two-sided limit; integer; or text.
    reason
        Unit and source of the value.
    """

    name: str
    value: float | int | str
    reason: str = ""

    @property
    def plain(self) -> float | int | str | dict[str, float]:
        """Value in the form that `load_config` accepts."""
        return self.value.plain if isinstance(self.value, TwoSided) else self.value

    def line(self) -> str:
        """Format the setting as a line of the file."""
        return f"{self.name}: {_format_value(self.value)}" + (f"   # {plain_line(self.reason)}" if self.reason else "")


@dataclass(frozen=True)
class IdentifiedConfiguration:
    """Values of the controller's configuration from an identification.

    Attributes
    ----------
    name
        Name of the model.
    general
        Settings without a group.
    groups
        Settings of each group in `_GROUPS`; a group may be empty.
    sensors
        Delays and scales of the sensors, by input.
    notes
        Warnings, which are comment lines at the start of the file.
    """

    name: str
    general: tuple[Setting, ...]
    groups: Mapping[str, Sequence[Setting]]
    sensors: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def bounds(self) -> tuple[Setting, ...]:
        """Limits of speeds and accelerations."""
        lengths = identification_settings().lengths
        return tuple(setting for setting in self.groups["limits"] if f"limits.{setting.name}" not in lengths)

    @property
    def room(self) -> tuple[Setting, ...]:
        """Lengths of all groups that exceed the defaults, because the robot is larger or faster."""
        lengths = identification_settings().lengths
        return tuple(s for group, settings in self.groups.items() for s in settings if f"{group}.{s.name}" in lengths)

    def slowed(self, shares: Mapping[str, float]) -> IdentifiedConfiguration:
        """Multiply the limits of "v" and "omega", and the corresponding predicted limits, by `shares`."""

        def reduce(setting: Setting) -> Setting:
            share = shares.get(setting.name.removeprefix("predicted_"), 1.0)
            if share == 1.0:
                return setting
            unit, _, reason = setting.reason.partition(", ")
            reason = f"{unit}, {100 * share:.0f} % of this, because faster trial drives failed: {reason}"
            return _setting(setting.name, _map_sides(setting.value, lambda side: share * side), reason)

        return replace(self, groups={**self.groups, "limits": [reduce(setting) for setting in self.groups["limits"]]})

    def mapping(self) -> dict[str, Any]:
        """Return keys and values for `load_config`; the model file is in the folder of the configuration."""
        content: dict[str, Any] = {setting.name: setting.value for setting in self.general}
        for group, settings in self.groups.items():
            if settings:
                content[group] = {setting.name: setting.plain for setting in settings}
        return {**content, **({"sensors": self.sensors} if self.sensors else {})}

    def text(self) -> str:
        """Format the configuration file, with a reason for each value."""
        has_slew = any(setting.name.endswith("_slew") for setting in self.groups["limits"])
        lines = [
            f"# Controller of {plain_line(self.name)}. "
            "Missing keys have the schema's default: diffdrive-mpc config schema",
            *(f"# {plain_line(note)}" for note in self.notes),
            *(setting.line() for setting in self.general),
            "limits:" if has_slew else f"limits:   {_UNKNOWN_SLEW}",
            *(f"  {setting.line()}" for setting in self._select("limits", expert=False)),
            *(_group("wheels", self.groups["wheels"]) or [_UNKNOWN_WHEELS]),
        ]
        texts = {
            name: ", ".join(f"{key}: {number:.6g}" for key, number in values.items())
            for name, values in self.sensors.items()
        }
        lines += _group("sensors", [Setting(name, f"{{{text}}}", _SENSORS) for name, text in texts.items()])
        lines += _group("failure", self._select("failure", expert=False))
        expert_lines = [line for group in self.groups for line in _group(group, self._select(group, expert=True))]
        lines += ["expert:", *(f"  {line}" for line in expert_lines)] if expert_lines else []
        return "\n".join(lines) + "\n"

    def _select(self, group: str, *, expert: bool) -> list[Setting]:
        """Select the settings of a group that belong to `expert:`, or that do not belong to it."""
        expert_keys = identification_settings().expert
        return [
            setting
            for setting in self.groups[group]
            if ({group, f"{group}.{setting.name}"} & set(expert_keys) != set()) == expert
        ]


def _group(name: str, settings: Sequence[Setting]) -> list[str]:
    """Format the lines of a group; no lines if the group has no settings."""
    return [f"{name}:", *(f"  {setting.line()}" for setting in settings)] if settings else []


def configure(
    name: str,
    identified: IdentifiedModel,
    train: Sequence[Record],
    geometry: WheelGeometry | None,
    slip: SlipPrior,
    *,
    validation: Sequence[Record] = (),
    mapping_track: float | None = None,
    keep_sample_time: bool = False,
    sensors: Mapping[str, Mapping[str, float]] | None = None,
    notes: tuple[str, ...] = (),
) -> IdentifiedConfiguration:
    """Configure the controller of an identified robot from its model and records.

    Parameters
    ----------
    name
        Name of the model.
    identified
        Identified model, with base effects if they were identified.
    train
        Training records of the model.
    geometry
        Wheel radius and track from the log; None if the log has no wheel speeds.
    slip
        Initial slip estimate of the filter.
    validation
        Held-out records, whose commands count for the limits of the commands.
    mapping_track
        Track stated by the mapping [m], for a log without wheel speeds.
    keep_sample_time
        True if the predicting model requires the sample time of the log.
    sensors
        Delays and scales of the sensors, by input.
    notes
        Warnings for the start of the file.

    Raises
    ------
    models.velocity_model.ModelError
        If the model cannot describe a robot.
    """
    commands = np.concatenate([record.command for record in (*train, *validation)])
    commanded = np.abs(commands)
    base = identified.base_effects.wheel_command
    gain = np.diag(identified.model.dc_gain)
    limit, speeds = _speed_limits(identified, commands, base, gain)
    if mapping_track is not None and geometry is None:
        geometry = WheelGeometry(np.nan, mapping_track)
    track = base.track if base else firmware_track(train, geometry, identified.model.dc_gain) if geometry else None
    assumed_track = track or load_robot().track
    max_side_speed = _max_side_speed(identified, train, assumed_track, geometry.track if geometry else assumed_track)
    rim_limit = _rim_limit(np.minimum(commanded, limit), assumed_track, base, float(gain[0]), max_side_speed)
    groups: dict[str, list[Setting]] = {name: [] for name in _GROUPS}
    groups["limits"] = [*_slew_limits(identified), *speeds, rim_limit]
    groups["estimator"] = [*_noise_settings(train), *_slip_settings(slip)]
    if geometry is not None and track is not None:
        groups["wheels"] = [
            _setting("track", track, "m, for the robot's conversion of omega_ref to wheel speeds"),
            _setting("encoder_track", geometry.track, f"m, {_source_of_track(geometry, mapping_track)}"),
        ]
    for group, settings in _scaled_lengths(limit[0] * gain[0], geometry).items():
        groups[group] += settings
    delay = (sensors or {}).get("pose", {}).get("delay", 0.0)
    for key, time in identification_settings().pose_times.items():
        if delay > 0.5 * time:
            group, _, key_name = key.partition(".")
            reason = f"s, the default {time:g} s and the delay of the poses"
            groups[group].append(_setting(key_name, time + delay, reason))
    general = _general_settings(identified, train[0].dt, keep_sample_time=keep_sample_time)
    return IdentifiedConfiguration(name, general, groups, sensors or {}, notes)


def _speed_limits(
    identified: IdentifiedModel, commands: FloatArray, base: WheelCommand | None, gain: FloatArray
) -> tuple[FloatArray, list[Setting]]:
    """Choose the speed limits: maxima (2,) of the commands (K, 2), and settings of commanded and predicted limits.

    If the log determines the limit of one side only, the limit of the other side is the maximum command of the log.
    """
    limit, sides = np.abs(commands).max(axis=0), np.maximum([commands.max(axis=0), -commands.min(axis=0)], 0.0).T
    top_speed = base.top_speed if base and (base.top_speed or np.inf) < limit[0] else None
    limits = {"v": top_speed, **identified.limits}
    settings, predictions = [], []
    for row, name in enumerate(CHANNELS):
        value, reason = limit[row], "maximum command of the log in both directions"
        if (low := sides[row].min()) < 0.5 * limit[row]:
            direction = _KINDS[name].names[sides[row].argmin()]
            reason += f", but {direction} only up to {low:.3g}: drive slowly in this direction"
        if (base_limit := limits.get(name)) is not None:
            pairs = zip(sides_of(base_limit), sides[row].tolist(), strict=True)
            values = [(commanded or float(base_limit)) if side == np.inf else side for side, commanded in pairs]
            limit[row], reason = max(values), "limit at which the robot clips its command"
            if max(sides_of(base_limit)) == np.inf:
                reason += ", and maximum command of the log on the side without a limit"
            value = _KINDS[name](*values)
        settings.append(_setting(name, value, f"{_UNITS[name]}, {reason}"))
        predicted = identification_settings().limit_margin * np.maximum(gain[row], 1.0) * limit[row]
        reason = f"{_UNITS[name]}, maximum of the robot or of the command, with a margin"
        predictions.append(_setting(f"predicted_{name}", predicted, reason))
    return limit, [*settings, *predictions]


def _source_of_track(geometry: WheelGeometry, mapping_track: float | None) -> str:
    if np.isnan(geometry.radius):
        return "as stated by the mapping"
    source = "for the computation of the log's omega"
    if mapping_track is not None and abs(geometry.track - mapping_track) > _TRACK_TOLERANCE * mapping_track:
        source += f"; the log's wheels determine it, so the {mapping_track:g} m of the mapping are not used"
    return source


def _scaled_lengths(speed: float, geometry: WheelGeometry | None) -> dict[str, list[Setting]]:
    """Scale lengths, by group, for a robot larger or faster than the papers' robot; empty for other robots."""
    default = load_robot()
    speed_ratio = speed / default.limits.v
    track_ratio = geometry.track / default.track if geometry is not None else 0.0
    scale, quantity = max((speed_ratio, "speed"), (track_ratio, "track"))
    settings: dict[str, list[Setting]] = {}
    if round(scale, 1) > 1.0:
        for key, length in identification_settings().lengths.items():
            group, _, name = key.partition(".")
            reason = f"m, {scale:.1f} times the default {length:g} m, like the robot's {quantity}"
            settings.setdefault(group, []).append(_setting(name, scale * length, reason))
    return settings


def _general_settings(identified: IdentifiedModel, dt: float, *, keep_sample_time: bool) -> tuple[Setting, ...]:
    pace = choose_pace(identified.model, dt)
    if keep_sample_time:
        pace = replace(pace, sample_time=dt, log_samples=1)
    samples = pace.log_samples
    source = "of the log" if samples == 1 else f"{samples} samples of the log, because the robot responds slowly"
    horizon = f"steps, {pace.horizon * pace.sample_time:.2f} s; the robot settles {pace.settling:.2f} s after a command"
    return (
        Setting("model", MODEL_FILE),
        Setting("sample_time", round_period(pace.sample_time), f"s, {source}: period of the calls of `step`"),
        Setting("horizon", pace.horizon, horizon),
    )


def _noise_settings(train: Sequence[Record]) -> tuple[Setting, ...]:
    """Return the noise settings that exceed the defaults."""
    deviations, minima = sensor_noise(train), identification_settings().min_noise
    return tuple(
        _setting(name, deviations[name], f"{_NOISE_UNITS[name]}, scatter of the log's readings")
        for name in minima
        if deviations.get(name, 0.0) > minima[name]
    )


def _slip_settings(prior: SlipPrior) -> list[Setting]:
    """Return the settings of the filter's initial slip estimate."""
    side_slip, load_shift = prior.estimate.values
    return [
        _setting("side_slip", side_slip, f"s, outward lateral speed over v omega: {prior.source()}"),
        _setting("side_slip_uncertainty", prior.estimate.deviation("side_slip"), "s, for this and other surfaces"),
        _setting("load_shift", load_shift, f"s^2, inward lateral speed over a omega: {prior.source()}"),
    ]


def _slew_limits(identified: IdentifiedModel) -> list[Setting]:
    """Choose slew limits below the identified acceleration limits of the base, at which the model is nonlinear."""
    parameters, settings = identified.parameters, identification_settings()
    default, limits = load_robot().command_slew, limits_in(identified.base_effects)
    slews = []
    for name, row in zip(CHANNELS, limits[:, 2:], strict=True):
        if row.min() == np.inf:
            continue
        sides = []
        for side, value in zip(SlewLimit.names, row.tolist(), strict=True):
            key = f"slew.{name}" if f"slew.{name}" in parameters.names else f"{name}.{side}"
            deviation = parameters.deviation(key) if value < np.inf else 0.0
            # Subtract the uncertainty, so that the limit of the base remains inactive; keep a minimum share.
            reduced, minimum = value - settings.slew_margin * deviation, settings.min_slew * value
            sides.append(min(reduced if reduced > minimum else minimum, getattr(default, name)))
        reason = f"{_UNITS[name]} per second, below the estimated limits of the base"
        slews.append(_setting(f"{name}_slew", SlewLimit(*sides), reason))
    return slews


def _max_side_speed(identified: IdentifiedModel, train: Sequence[Record], track: float, encoder_track: float) -> float:
    """Return the maximum measured speed of a side [m/s] if the robot does not reach its commands, otherwise infinity.

    The robot limits v, or its faster side does not follow the fastest commands, delayed by lag and dead time of the
    model. Weak motors also limit the speed of a side without a limit of v or omega.
    """
    model, records = identified.model, [record for record in train if record.twist is not None]
    responses = [model.discretise(record.dt).simulate(record.command) / np.diag(model.dc_gain) for record in records]
    twist = np.concatenate([record.twist for record in records])
    measured = np.abs(twist) @ [1.0, 0.5 * encoder_track]
    expected = np.abs(np.concatenate(responses)) @ [1.0, 0.5 * track]
    is_fast = (expected >= np.percentile(expected, _FAST_PERCENTILE)) & np.isfinite(measured)
    if "v" not in identified.limits and measured[is_fast].sum() >= _REACHED_SHARE * expected[is_fast].sum():
        return np.inf
    return float(np.nanpercentile(measured, 99.5))


def _rim_limit(commands: FloatArray, track: float, base: WheelCommand | None, gain: float, maximum: float) -> Setting:
    """Choose the limit of the wheel speed; `commands` (K, 2) are magnitudes of the commands in the log."""
    limit = identification_settings().limit_margin * float((commands[:, 0] + 0.5 * track * commands[:, 1]).max())
    if base is not None and base.top_speed is not None and gain * base.top_speed < limit:
        return _setting("wheel_speed", gain * base.top_speed, "m/s at the rim; the motors saturate")
    if maximum < limit:
        return _setting("wheel_speed", maximum, "m/s at the rim, maximum in the log, which is below the commands")
    return _setting("wheel_speed", limit, "m/s at the rim, the maximum command of a side in the log, with a margin")


def _setting(name: str, value: float, reason: str) -> Setting:
    return Setting(name, _map_sides(value, lambda side: float(f"{side:.4g}")), reason)


def _map_sides(value: float | str, change: Callable[[float], float]) -> float:
    """Apply `change` to a number or to each side of a limit."""
    return value.map(change) if isinstance(value, TwoSided) else change(float(value))


def _max_side(value: float | str) -> float:
    """Return the larger side of a limit."""
    return max(sides_of(value)) if isinstance(value, TwoSided) else float(value)


def _format_value(value: float | str) -> str:
    """Format a value for the file."""
    if isinstance(value, TwoSided) and not value.is_symmetric:
        return "{" + ", ".join(f"{name}: {side:.6g}" for name, side in zip(value.names, value.sides, strict=True)) + "}"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def apply_stated_values(configuration: IdentifiedConfiguration, robot: ManufacturerRobot) -> IdentifiedConfiguration:
    """Reduce limits to those stated by the manufacturer, and add stated values that the log does not determine.

    The base clips commands at the manufacturer's limits, so the controller's model is wrong beyond them.
    """
    keys = robot.configuration()
    shares: dict[str, float] = {
        setting.name: min(1.0, float(keys[f"limits.{setting.name}"].value) / _max_side(setting.value))
        for setting in configuration.groups["limits"]
        if setting.name in CHANNELS
    }
    groups = {name: list(settings) for name, settings in configuration.groups.items()}
    groups["limits"] = [_reduce_to_stated(setting, keys, shares, robot.name) for setting in groups["limits"]]
    for key, entry in keys.items():
        group, _, name = key.partition(".")
        if name not in {setting.name for setting in groups[group]}:
            value = f"'{entry.value}'" if isinstance(entry.value, str) else entry.value
            groups[group].append(Setting(name, value, f"{entry.reason}, stated by the manufacturer of {robot.name}"))
    return replace(configuration, groups=groups)


def _reduce_to_stated(setting: Setting, keys: dict[str, StatedKey], shares: dict[str, float], robot: str) -> Setting:
    """Reduce a limit to the stated limit; reduce predicted limits by the same share."""
    unit, value = setting.reason.partition(", ")[0], _max_side(setting.value)
    stated, share = keys.get(f"limits.{setting.name}"), shares.get(setting.name.removeprefix("predicted_"), 1.0)
    if stated is not None and float(stated.value) < value:
        maximum = float(stated.value)
        reason = f"{unit}, stated by the manufacturer of {robot}; limit from the log: {_format_value(setting.value)}"
        return Setting(setting.name, _map_sides(setting.value, lambda side: min(side, maximum)), reason)
    if share < 1.0 and stated is None:
        return Setting(setting.name, float(f"{share * value:.4g}"), f"{unit}, for the limit stated by the manufacturer")
    return setting
