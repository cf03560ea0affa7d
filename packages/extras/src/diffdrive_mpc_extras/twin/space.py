"""Parameters of a fit, and conversion of their values to a robot."""

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
"""Parameter values by name."""
_SLEW_PARAMETERS = ("slew_v", "slew_omega")
_GYRO_PARAMETERS = ("encoders_delay", "encoders_lag", "gyro_offset", "wheel_base", "veer")


@dataclass(frozen=True)
class Space:
    """Space of the parameters, with their priors.

    Attributes
    ----------
    nominal
        Initial robot; factors multiply its values.
    effects
        Effects of the base in the identified model: slew limits are fitted, steps and coasting are fixed.
    priors
        Priors by name.
    travel
        Metres travelled for each metre that the encoders count [-].
    """

    nominal: Nominal
    effects: BaseEffects
    priors: Mapping[str, Prior]
    travel: float = 1.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters, including those of the log's sensors."""
        return tuple(self.priors)

    def values(self, z: FloatArray) -> dict[str, float]:
        """Convert deviations `z` (q,) from the medians of the priors to values."""
        return {
            name: prior.value(float(deviation)) for (name, prior), deviation in zip(self.priors.items(), z, strict=True)
        }

    def deviations(self, values: Values) -> FloatArray:
        """Convert values to deviations (q,) inside the bounds; zero for missing parameters."""
        z = [prior.z(values[name]) if name in values else 0.0 for name, prior in self.priors.items()]
        low, high = self.bounds
        margin = 1e-3 * (high - low)
        return np.clip(z, low + margin, high - margin)

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """(q,) minimum and maximum deviations."""
        low, high = ([prior.z(getattr(prior, end)) for prior in self.priors.values()] for end in ("low", "high"))
        return np.array(low), np.array(high)

    @property
    def steps(self) -> FloatArray:
        """(q,) steps of finite differences, in deviations."""
        return np.array([prior.step / prior.deviation for prior in self.priors.values()])

    def robot(self, values: Values) -> SimulatedRobot:
        """Build the plant; parameters outside this space have the median of their prior."""
        values = {name: prior.prior for name, prior in twin_settings().parameters.items()} | dict(values)
        start = self.nominal.robot
        chassis, motor, driver = start.twin.chassis, start.twin.motor, start.twin.driver
        track = values["track"] * self.nominal.track_of_encoders
        length, width, height = chassis.body_size
        changes: dict[str, Any] = {
            "robot": {"mass": values["mass"] * start.robot.mass},
            "twin": {
                "chassis": {
                    "wheel_base": values["wheel_base"] * chassis.wheel_base,
                    "body_size": [values["inertia"] * length, values["inertia"] * width, height],
                    "wheel_mass": values["mass"] * chassis.wheel_mass,
                    "rolling_radii": [self.travel * (1 + values["veer"] / 2), self.travel * (1 - values["veer"] / 2)],
                },
                "tyre": {"creep_time": values["creep"] * start.twin.tyre.creep_time},
                "motor": {
                    "stall_torque": values["torque"] * motor.stall_torque,
                    "no_load_speed": values["top_speed"] * motor.no_load_speed,
                },
                "driver": {
                    "proportional_gain": values["driver"] * driver.proportional_gain,
                    "integral_gain": values["driver"] * driver.integral_gain,
                },
                "link": {"dead_time": values["dead_time"]},
            },
            "firmware": {name: values[name] for name in ("gain_v", "lag_v", "lag_omega")} | {"track": track},
            "friction": values["friction"],
        }
        base: dict[str, Any] = {}
        if self.effects.twist_slew is not None:
            base["twist_slew"] = {"v": values["slew_v"], "omega": values["slew_omega"]}
        if self.effects.wheel_command is not None:
            base["wheel_command"] = self.effects.wheel_command.model_dump() | {"track": track}
        if base:
            changes["base"] = base
        return SimulatedRobot.model_validate(merge_mappings(start.model_dump(), changes))


def space_of(
    nominal: Nominal, effects: BaseEffects, *, has_gyro: bool, has_encoder_lag: bool, travel: float = 1.0
) -> Space:
    """Build the space of the parameters that a log may determine.

    Parameters
    ----------
    nominal
        Initial robot.
    effects
        Effects of the base in the identified model.
    has_gyro
        True if the log has a gyro; the parameters between wheels and body and of the encoders need it.
    has_encoder_lag
        True if the identified model has a lag of the log's encoders.
    travel
        Metres travelled for each metre that the encoders count [-].
    """
    skipped = set() if effects.twist_slew else set(_SLEW_PARAMETERS)
    skipped |= set() if has_gyro else set(_GYRO_PARAMETERS)
    skipped |= set() if has_encoder_lag else {"encoders_lag"}
    priors = {
        name: prior.with_median(stated=name in nominal.stated)
        for name, prior in twin_settings().parameters.items()
        if name not in skipped
    }
    return Space(nominal, effects, priors, travel)
