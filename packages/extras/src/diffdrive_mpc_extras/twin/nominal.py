"""The robot that a fit begins with: the user's file, and missing values scaled from the papers' robot.

Lengths of the body go with the track, wheel masses with the mass, torques with weight times wheel radius, gains of the
motors' loops with one over their speed. MuJoCo's contact has time constants and ratios alone, so it is as soft for
600 kg as for 6 kg, and the step of the physics need not change.
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

_STATED = {
    "mass": ("robot", "mass"),
    "wheel_base": ("twin", "chassis", "wheel_base"),
    "inertia": ("twin", "chassis", "body_size"),
    "torque": ("twin", "motor", "stall_torque"),
    "top_speed": ("twin", "motor", "no_load_speed"),
    "driver": ("twin", "driver", "proportional_gain"),
}
"""Places of a parameter's number in a robot file."""


@dataclass(frozen=True)
class Nominal:
    """Start of the fit.

    Attributes
    ----------
    robot
        The robot.
    stated
        Parameters whose number the user's file says.
    track_of_encoders
        By which omega of the log's encoders was computed [m].
    """

    robot: SimulatedRobot
    stated: frozenset[str]
    track_of_encoders: float

    def clipping(self, levels: FloatArray) -> Nominal:
        """Return the start with a link that clips v and omega at these levels (2,), infinite for no limit."""
        limits = self.robot.robot.limits
        lower = {name: min(getattr(limits, name), float(level)) for name, level in zip(CHANNELS, levels, strict=True)}
        body = self.robot.robot.model_copy(update={"limits": limits.model_copy(update=lower)})
        return replace(self, robot=self.robot.model_copy(update={"robot": body}))


def nominal_robot(name: str, records: Sequence[Record], file: str | Path | None = None) -> Nominal:
    """Estimate the robot behind some records.

    Parameters
    ----------
    name
        Description of the robot, in a line.
    records
        Records to fit.
    file
        Robot file, of which nothing is compulsory where the records have wheel speeds; shipped name or path.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file has a mistake, or neither it nor the records determine track and wheel radius.
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
            f"{where}: the log has no wheel speeds, so track and wheel radius are unknown; give --robot a file with "
            "robot: {track: ..., wheel_radius: ...} [m]"
        )
    assert track is not None and radius is not None
    mass = body.get("mass")
    usual = load_robot()
    if not (isinstance(mass, (int, float)) and mass > 0):
        mass = usual.mass * (track / usual.track) ** 3
    data = merge_mappings(_scaled(name, records, float(track), float(radius), float(mass)), stated_data)
    stated = frozenset(key for key, path in _STATED.items() if _holds(stated_data, path))
    return Nominal(check(SimulatedRobot, data, where), stated, float(geometry.track if geometry else track))


def _scaled(name: str, records: Sequence[Record], track: float, radius: float, mass: float) -> dict[str, Any]:
    """Scale the papers' robot to the size, mass and speed of another."""
    settings, usual, twin = twin_settings(), load_robot(), load_twin_parameters().model_dump()
    command = np.abs(np.concatenate([record.command for record in records])).max(axis=0)
    limits = settings.limit_margin * np.maximum(command, 1e-3)
    fastest = (command[0] + 0.5 * settings.parameters["track"].prior * track * command[1]) / radius
    size, weight = track / usual.track, mass / usual.mass
    chassis, motor, driver = twin["chassis"], twin["motor"], twin["driver"]
    chassis["body_size"] = [size * length for length in chassis["body_size"]]
    chassis["body_height"] *= size
    chassis["wheel_base"] = settings.wheel_base_share * track
    chassis["wheel_mass"] *= weight
    no_load = settings.speed_margin * float(fastest)
    quicker = no_load / motor["no_load_speed"]
    leverage = weight * radius / usual.wheel_radius
    motor["stall_torque"] *= leverage
    motor["rotor_inertia"] *= leverage * radius / usual.wheel_radius
    motor["no_load_speed"] = no_load
    motor["spread"] = [1.0, 1.0, 1.0, 1.0]
    driver["proportional_gain"] /= quicker
    driver["integral_gain"] /= quicker
    body = usual.model_dump() | {
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
    """Estimate noise and rates from the log; values that it does not show are those of the default set."""
    noise, sensors = sensor_noise(records), load_sensor_set(DEFAULT).model_dump()
    if "yaw_rate_noise" in noise:
        sensors["gyro"]["noise_sd"] = noise["yaw_rate_noise"]
    if "wheel_speed_noise" in noise:
        # v is the mean of four wheels.
        sensors["encoders"]["speed_sd"] = max(2.0 * noise["wheel_speed_noise"] / radius, 1e-6)
    if "position_noise" in noise:
        sensors["pose"] |= {"position_sd": noise["position_noise"], "heading_sd": noise.get("heading_noise", 0.0)}
    steps = [
        float(np.median(np.diff(np.flatnonzero(record.fresh_pose)))) * record.dt
        for record in records
        if record.fresh_pose is not None and record.fresh_pose.sum() > 2
    ]
    if steps:
        sensors["pose"]["period"] = max(float(np.median(steps)), 1e-3)
    return sensors


def _holds(stated_data: Mapping[str, Any], path: Sequence[str]) -> bool:
    place: Any = stated_data
    for key in path:
        if not isinstance(place, Mapping) or key not in place:
            return False
        place = place[key]
    return True
