"""The parameters of a fit, and the robot that their values describe."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.checked_yaml import merge_mappings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.plants.simulated_robot import SimulatedRobot
from diffdrive_mpc_extras.twin.nominal import Nominal
from diffdrive_mpc_extras.twin.settings import Prior, twin_settings

Values = Mapping[str, float]
"""Values of every parameter, by name."""
_SLEW = ("slew_v", "slew_omega")
_WITH_GYRO = ("encoders_delay", "encoders_lag", "gyro_offset", "wheel_base", "veer")


@dataclass(frozen=True)
class Space:
    """Space of the parameters, with their priors.

    Attributes
    ----------
    nominal
        The robot that factors multiply.
    effects
        Effects of the base in the identified model: slope limits are fitted, steps and coasting are taken over.
    priors
        By name.
    travel
        Metres travelled for each metre that the encoders count [-].
    """

    nominal: Nominal
    effects: BaseEffects
    priors: Mapping[str, Prior]
    travel: float = 1.0

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of all parameters, those of the log's sensors included."""
        return tuple(self.priors)

    def values(self, z: FloatArray) -> dict[str, float]:
        """Compute values for deviations `z` (q,) from the priors' medians."""
        return {
            name: prior.value(float(deviation)) for (name, prior), deviation in zip(self.priors.items(), z, strict=True)
        }

    def deviations(self, values: Values) -> FloatArray:
        """Invert `values` inside the bounds: (q,), zero for missing ones."""
        z = [prior.z(values[name]) if name in values else 0.0 for name, prior in self.priors.items()]
        low, high = self.bounds
        inside = 1e-3 * (high - low)
        return np.clip(z, low + inside, high - inside)

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """(q,) least and largest deviations."""
        low, high = ([prior.z(getattr(prior, end)) for prior in self.priors.values()] for end in ("low", "high"))
        return np.array(low), np.array(high)

    @property
    def steps(self) -> FloatArray:
        """(q,) of finite differences, in deviations."""
        return np.array([prior.step / prior.deviation for prior in self.priors.values()])

    def robot(self, values: Values) -> SimulatedRobot:
        """Build the plant; parameters outside this space have their prior."""
        numbers = {name: prior.prior for name, prior in twin_settings().parameters.items()} | dict(values)
        start = self.nominal.robot
        chassis, motor, driver = start.twin.chassis, start.twin.motor, start.twin.driver
        track = numbers["track"] * self.nominal.track_of_encoders
        length, width, height = chassis.body_size
        changes: dict[str, Any] = {
            "robot": {"mass": numbers["mass"] * start.robot.mass},
            "twin": {
                "chassis": {
                    "wheel_base": numbers["wheel_base"] * chassis.wheel_base,
                    "body_size": [numbers["inertia"] * length, numbers["inertia"] * width, height],
                    "wheel_mass": numbers["mass"] * chassis.wheel_mass,
                    "rolling_radii": [self.travel * (1 + numbers["veer"] / 2), self.travel * (1 - numbers["veer"] / 2)],
                },
                "tyre": {"creep_time": numbers["creep"] * start.twin.tyre.creep_time},
                "motor": {
                    "stall_torque": numbers["torque"] * motor.stall_torque,
                    "no_load_speed": numbers["top_speed"] * motor.no_load_speed,
                },
                "driver": {
                    "proportional_gain": numbers["driver"] * driver.proportional_gain,
                    "integral_gain": numbers["driver"] * driver.integral_gain,
                },
                "link": {"dead_time": numbers["dead_time"]},
            },
            "firmware": {name: numbers[name] for name in ("gain_v", "lag_v", "lag_omega")} | {"track": track},
            "friction": numbers["friction"],
        }
        base: dict[str, Any] = {}
        if self.effects.twist_slew is not None:
            base["twist_slew"] = {"v": numbers["slew_v"], "omega": numbers["slew_omega"]}
        if self.effects.wheel_command is not None:
            base["wheel_command"] = self.effects.wheel_command.model_dump() | {"track": track}
        if base:
            changes["base"] = base
        return SimulatedRobot.model_validate(merge_mappings(start.model_dump(), changes))


def space_of(nominal: Nominal, effects: BaseEffects, *, gyro: bool, lagging: bool, travel: float = 1.0) -> Space:
    """Build the space of the parameters that a log may determine.

    Parameters
    ----------
    nominal
        The robot to begin with.
    effects
        Effects of the base in the identified model.
    gyro
        Whether the log has a gyro; without one, the parameters between wheels and body and between encoders and robot
        cannot be determined.
    lagging
        Whether the identified model found the log's encoders to lag.
    travel
        Region of the drive, as of `Space`.
    """
    skipped = set() if effects.twist_slew else set(_SLEW)
    skipped |= set() if gyro else set(_WITH_GYRO)
    skipped |= set() if lagging else {"encoders_lag"}
    priors = {
        name: prior.with_median(stated=name in nominal.stated)
        for name, prior in twin_settings().parameters.items()
        if name not in skipped
    }
    return Space(nominal, effects, priors, travel)
