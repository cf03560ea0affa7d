"""Initial robot of a fit: the user's file, with missing values scaled from the robot of the papers.

Lengths of the body scale with the track, wheel masses with the mass, torques with weight times wheel radius, and gains
of the motor loops with the inverse of their speed. Contacts in MuJoCo depend on time constants and ratios only. Their
relative stiffness is therefore equal for 600 kg and 6 kg, and the physics step does not change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError, check, merge_mappings
from diffdrive_mpc.models.identification.fit.noise import sensor_noise
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.geometry import wheel_geometry
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.models.velocity_model import CHANNELS
from diffdrive_mpc.sim.plants.simulated_robot import DEFAULT, ROBOTS, SimulatedRobot
from diffdrive_mpc.sim.plants.twin_parameters import load_firmware, load_twin_parameters
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from diffdrive_mpc_extras.twin.settings import twin_settings

_KEYS = {
    "mass": ("robot", "mass"),
    "wheel_base": ("twin", "chassis", "wheel_base"),
    "inertia": ("twin", "chassis", "body_size"),
    "torque": ("twin", "motor", "stall_torque"),
    "top_speed": ("twin", "motor", "no_load_speed"),
    "driver": ("twin", "driver", "proportional_gain"),
}
"""Keys of each parameter in a robot file."""


@dataclass(frozen=True)
class Nominal:
    """Initial robot of the fit.

    Attributes
    ----------
    robot
        Initial robot.
    stated
        Parameters with a value in the user's file.
    track_of_encoders
        Track in the computation of the encoders' omega in the log [m].
    """

    robot: SimulatedRobot
    stated: frozenset[str]
    track_of_encoders: float

    def with_limits(self, levels: FloatArray) -> Nominal:
        """Return a copy that clips v [m/s] and omega [rad/s] at `levels` (2,), infinite for no limit."""
        limits = self.robot.robot.limits
        reduced = {name: min(getattr(limits, name), float(level)) for name, level in zip(CHANNELS, levels, strict=True)}
        body = self.robot.robot.model_copy(update={"limits": limits.model_copy(update=reduced)})
        return replace(self, robot=self.robot.model_copy(update={"robot": body}))


def nominal_robot(name: str, records: Sequence[Record], file: str | Path | None = None) -> Nominal:
    """Estimate the initial robot from records and a robot file.

    Parameters
    ----------
    name
        Description of the robot in one line.
    records
        Records to fit.
    file
        Robot file, shipped name or path. If the records have wheel speeds, all of its keys are optional.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file is invalid, or neither the file nor the records determine track and wheel radius.
    """
    stated_data: Mapping[str, Any] = {}
    where = name
    if file is not None:
        content, where = ROBOTS.read(file)
        if not isinstance(content, Mapping):
            raise ConfigError(f"{where}: expected keys and values, such as robot: {{mass: 50}} [kg]")
        stated_data = content
    geometry = wheel_geometry(records)
    body = stated_data.get("robot") if isinstance(stated_data.get("robot"), Mapping) else {}
    assert isinstance(body, Mapping)
    track = geometry.track if geometry else body.get("track")
    radius = geometry.radius if geometry else body.get("wheel_radius")
    if not all(isinstance(length, (int, float)) and length > 0 for length in (track, radius)):
        raise ConfigError(
            f"{where}: the log has no wheel speeds, and track and wheel radius are unknown; use --robot with a file "
            "that contains robot: {track: ..., wheel_radius: ...} [m]"
        )
    assert track is not None and radius is not None
    mass = body.get("mass")
    default = load_robot()
    if not (isinstance(mass, (int, float)) and mass > 0):
        mass = default.mass * (track / default.track) ** 3
    data = merge_mappings(_scaled_robot(name, records, float(track), float(radius), float(mass)), stated_data)
    stated = frozenset(key for key, path in _KEYS.items() if _has_key(stated_data, path))
    return Nominal(check(SimulatedRobot, data, where), stated, float(geometry.track if geometry else track))


def _scaled_robot(name: str, records: Sequence[Record], track: float, radius: float, mass: float) -> dict[str, Any]:
    """Scale the robot of the papers to track [m], wheel radius [m], mass [kg] and the commands of the records."""
    settings, default, twin = twin_settings(), load_robot(), load_twin_parameters().model_dump()
    command = np.abs(np.concatenate([record.command for record in records])).max(axis=0)
    limits = settings.limit_margin * np.maximum(command, 1e-3)
    max_wheel_speed = (command[0] + 0.5 * settings.parameters["track"].prior * track * command[1]) / radius
    size, weight = track / default.track, mass / default.mass
    chassis, motor, driver = twin["chassis"], twin["motor"], twin["driver"]
    chassis["body_size"] = [size * length for length in chassis["body_size"]]
    chassis["body_height"] *= size
    chassis["wheel_base"] = settings.wheel_base_share * track
    chassis["wheel_mass"] *= weight
    no_load = settings.speed_margin * float(max_wheel_speed)
    speed_ratio = no_load / motor["no_load_speed"]
    torque_ratio = weight * radius / default.wheel_radius
    motor["stall_torque"] *= torque_ratio
    motor["rotor_inertia"] *= torque_ratio * radius / default.wheel_radius
    motor["no_load_speed"] = no_load
    motor["spread"] = [1.0, 1.0, 1.0, 1.0]
    driver["proportional_gain"] /= speed_ratio
    driver["integral_gain"] /= speed_ratio
    body = default.model_dump() | {
        "name": name,
        "track": track,
        "wheel_radius": radius,
        "mass": mass,
        "encoder_pulses": settings.encoder_pulses,
        "limits": {"v": float(limits[0]), "omega": float(limits[1]), "wheel_speed": no_load},
    }
    sensors = _sensors(records, radius)
    return {
        "description": name,
        "robot": body,
        "twin": twin,
        "firmware": load_firmware().model_dump() | {"provenance": {}},
        "sensors": sensors,
    }


def _sensors(records: Sequence[Record], radius: float) -> dict[str, Any]:
    """Estimate noise and rates of the sensors from the records; other values are those of the default set."""
    noise, sensors = sensor_noise(records), load_sensor_set(DEFAULT).model_dump()
    if "yaw_rate_noise" in noise:
        sensors["gyro"]["noise_sd"] = noise["yaw_rate_noise"]
    if "wheel_speed_noise" in noise:
        # The noise of v is half that of one wheel, because v is the mean of four wheels.
        sensors["encoders"]["speed_sd"] = max(2.0 * noise["wheel_speed_noise"] / radius, 1e-6)
    if "position_noise" in noise:
        sensors["pose"] |= {"position_sd": noise["position_noise"], "heading_sd": noise.get("heading_noise", 0.0)}
    periods = [
        float(np.median(np.diff(np.flatnonzero(record.fresh_pose)))) * record.dt
        for record in records
        if record.fresh_pose is not None and record.fresh_pose.sum() > 2
    ]
    if periods:
        sensors["pose"]["period"] = max(float(np.median(periods)), 1e-3)
    return sensors


def _has_key(stated_data: Mapping[str, Any], path: Sequence[str]) -> bool:
    node: Any = stated_data
    for key in path:
        if not isinstance(node, Mapping) or key not in node:
            return False
        node = node[key]
    return True
