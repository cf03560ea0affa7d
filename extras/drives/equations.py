"""One channel of a drive from sample to sample, v or omega: what the reference becomes, and how the robot follows it.

Source: Ivanjko et al., Modelling of Mobile Robot Dynamics, sections 2 and 3. Its dead time of whole samples stands
before all of this; the gain is ours, for a gyro on a robot that skids. The paper draws the parts of the experimental
model, but does not say in which order their states are kept; that is ours.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np
from scipy.linalg import expm

from diffdrive_mpc.extras.drives.smoothing import Shapes, Sharp, Smooth
from diffdrive_mpc.models.interface import FloatArray

STATES = 4
"""Of a channel: both models have the slope-limited reference first and the speed second."""
SLOPE_LAG = 0.1
"""Time constant with which the slope of the reference is told [s]: the sample time of the paper."""
FORGETTING = 10.0
"""After this time at rest [s] the last direction of travel no longer counts: a state must not stay for ever."""


class Channel(NamedTuple):
    """What both models need of a channel besides their own numbers."""

    dt: float
    """[s]"""
    still: float
    """speed below which the robot stands [m/s or rad/s]; the threshold is rounded over as much"""


def experimental_step(channel: Channel, *, sharp: bool) -> ca.Function:
    """x, u, c -> x one sample later, by section 2.2 and Figure 8.

    x: slope-limited reference, speed, slope of the reference, last direction of travel (-1 to 1). u: command after the
    dead time. c: gain [-], largest slope when speeding up and when slowing down, lag [s], threshold without slope and
    by slope [s]. After a change of direction the robot stands while the reference rises and is below the threshold.
    """
    shapes: Shapes = Sharp() if sharp else Smooth()
    x, u, c = ca.SX.sym("x", STATES), ca.SX.sym("u"), ca.SX.sym("c", 6)
    reference, speed, slope, direction = ca.vertsplit(x)
    gain, quicker, slower, lag, least, by_slope = ca.vertsplit(c)
    dt, still = channel
    ramped = _ramped(shapes, channel, reference, u, quicker, slower)
    slope = slope + (1 - np.exp(-dt / SLOPE_LAG)) * (shapes.size((ramped - reference) / dt, still / SLOPE_LAG) - slope)
    # Only against the last direction, and only while the reference rises and has not passed the threshold.
    against = shapes.positive(-direction * shapes.sign(ramped, still))
    steady = still / SLOPE_LAG
    rising = shapes.exceeds(slope - steady, steady)
    below = shapes.exceeds(least + by_slope * slope - shapes.size(ramped, still), still)
    speed = speed + (1 - ca.exp(-dt / lag)) * (gain * ramped * (1 - against * rising * below) - speed)
    # Rounded with a high power: what leaks through the threshold must not count as travel.
    pace = speed / (2 * still)
    moving = shapes.exceeds(shapes.size(speed, still) - still, still) if sharp else pace**4 / (pace**4 + 1)
    direction = direction * np.exp(-dt / FORGETTING)
    direction = direction + moving * (shapes.sign(speed, still) - direction)
    after = ca.vertcat(ramped, speed, slope, direction)
    return ca.Function("step", [x, u, c], [after], ["x", "u", "c"], ["after"])


def physical_step(channel: Channel, *, sharp: bool) -> ca.Function:
    """x, u, c -> x one sample later, by equations 14 to 17 with PI control and the lag of the actuator.

    x: slope-limited reference, speed, torque and integral of the error of `wheel_response`. u: command after the dead
    time. c: gain [-], largest slope when speeding up and when slowing down, then the response by columns (3, 4).
    """
    shapes: Shapes = Sharp() if sharp else Smooth()
    x, u, c = ca.SX.sym("x", STATES), ca.SX.sym("u"), ca.SX.sym("c", 15)
    gain, quicker, slower = ca.vertsplit(c[:3])
    ramped = _ramped(shapes, channel, x[0], u, quicker, slower)
    after = ca.vertcat(ramped, ca.reshape(c[3:], 3, 4) @ ca.vertcat(x[1:], gain * ramped))
    return ca.Function("step", [x, u, c], [after], ["x", "u", "c"], ["after"])


def wheel_response(
    stiffness: float, friction: float, integral_time: float, actuator_lag: float, dt: float
) -> FloatArray:
    """(3, 4) one sample of both wheels together or against each other: columns state (3), reference held meanwhile.

    Equations 14 and 15 added and subtracted: (A + B) and (A - B) are the inertias that both wheels have together
    and against each other, so speed' = torque - friction speed, with everything divided by that inertia.
    torque' = (stiffness (error + integral / integral_time) - torque) / actuator_lag; integral' = error.

    Parameters
    ----------
    stiffness
        Gain of the controller over inertia [1/s].
    friction
        Viscous friction over inertia [1/s].
    integral_time, actuator_lag, dt
        [s].
    """
    continuous = np.array(
        [
            [-friction, 1.0, 0.0, 0.0],
            [
                -stiffness / actuator_lag,
                -1 / actuator_lag,
                stiffness / integral_time / actuator_lag,
                stiffness / actuator_lag,
            ],
            [-1.0, 0.0, 0.0, 1.0],
            [0.0, 0.0, 0.0, 0.0],
        ]
    )
    return np.asarray(expm(dt * continuous)[:3])


def _ramped(shapes: Shapes, channel: Channel, reference: ca.SX, u: ca.SX, quicker: ca.SX, slower: ca.SX) -> ca.SX:
    """The reference one sample later, on its way to `u`, with slopes up to `quicker` and, towards zero, `slower`."""
    dt, still = channel
    towards = (1 - shapes.sign(reference, still) * shapes.sign(u - reference, still)) / 2
    most = dt * (quicker + (slower - quicker) * towards)
    return reference + most * shapes.limited((u - reference) / most)
