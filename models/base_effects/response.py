"""The group `base_effects` of a model file, and a free run of a velocity model with these effects around it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from diffdrive_mpc.models.base_effects.body import PoseMount, Veer, YawRelaxation
from diffdrive_mpc.models.base_effects.commands import TwistSlew, WheelCommand
from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.velocity_model import VelocityModel


class BaseEffects(StrictModel):
    """What the base does around the linear model of the same file; an effect left out is not there."""

    twist_slew: TwistSlew | None = Field(default=None, description="acceleration limits inside the base")
    wheel_command: WheelCommand | None = Field(default=None, description="steps, coasting and top speed of the motors")
    yaw_relaxation: YawRelaxation | None = Field(default=None, description="twist of the tyres at changes of direction")
    veer: Veer | None = Field(default=None, description="yaw of the body while the wheels drive straight")
    pose_mount: PoseMount | None = Field(default=None, description="where the pose sensor sits")


PARTS = 4
"""Inside a sample the base ramps; its limited command is held over this fraction of a sample."""


class Response(NamedTuple):
    """Twists at the samples of the commands."""

    wheels: FloatArray
    """(K, 2) v [m/s], omega [rad/s] that encoders with the effective track see."""
    body: FloatArray
    """(K, 2) v [m/s], omega [rad/s] of the body, which gyro and poses see."""


def respond(
    model: VelocityModel, effects: BaseEffects, commands: ArrayLike, dt: float, start: ArrayLike = (0.0, 0.0)
) -> Response:
    """Simulate from commands alone: slew, wheel commands, linear dynamics, twist of the tyres, veer.

    Parameters
    ----------
    model
        The linear dynamics, from what the motors are asked for to the settled twist of the body.
    effects
        What the base does around them.
    commands
        (K, 2) v_ref [m/s], omega_ref [rad/s], each held from its sample to the next.
    dt
        Sample time [s].
    start
        (2,) the command under which the robot is settled at sample 0.

    Raises
    ------
    ValueError
        If the commands are not K rows of two finite numbers.
    models.velocity_model.ModelError
        If `dt` is not positive and finite.
    """
    commands = np.asarray(commands, dtype=float)
    if commands.ndim != 2 or commands.shape[1] != 2 or not np.isfinite(commands).all():
        raise ValueError(f"commands of shape {commands.shape}: expected K rows of finite v_ref, omega_ref")
    start = np.asarray(start, dtype=float)
    sampled = model.discretise(dt / PARTS)
    asked = np.repeat(commands, PARTS, axis=0)
    if effects.twist_slew is not None:
        asked = effects.twist_slew.follow(asked, dt / PARTS, start)
    if effects.wheel_command is not None:
        asked, start = effects.wheel_command.apply(asked), effects.wheel_command.apply(start)
    past = np.tile(start, (sampled.memory, 1))
    wheels = sampled.simulate(asked, sampled.settled_state(start), past)
    body = wheels.copy()
    if effects.yaw_relaxation is not None and len(body):
        body[:, 1] = effects.yaw_relaxation.follow(wheels[:, 1], dt / PARTS, float(np.sign(wheels[0, 1])))
    if effects.veer is not None:
        body = effects.veer.body(body)
    return Response(wheels[::PARTS], body[::PARTS])
