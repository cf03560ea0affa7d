"""Torque of the outer and the inner side against turn radius and speed.

Ordonez et al., 2017 (P4), sections 2.2 and 2.3: a command gives wheel speeds by the base's own kinematics and the
motion of the body by the slip law, both together the sliding under the tyres, and that the torque (equation 13). What
the paper leaves to its references is chosen here:

* **S_o**, how far the centre of the turn lies ahead of the middle, is where the lateral forces of the tyres balance the
  centripetal one.
* **Forward speed** is where the tractions balance. A slip law's forward terms hold errors of the wheel radius, too: the
  printed a11 = 0.015 alone would have both sides of a robot that drives straight on brake it.
* **Yaw rate** is that of the slip law; without one, the one at which the moments balance.
* **F_ri, F_ro** are the drag of the drive train and a rolling coefficient times load, against the wheels' turning.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.terrain.shear import Forces, floor_forces, inertial_wrench
from diffdrive_mpc_extras.terrain.terrain_file import Terrain
from diffdrive_mpc_extras.turn_costs.vehicle import Vehicle

_ITERATIONS = 200
# Balance counts as found when what is left is so small over the weight.
_BALANCED = 1e-7


class SideTorques(NamedTuple):
    """A steady turn, n conditions. A radius that is negative turns clockwise: then the left side is the outer one."""

    outer: FloatArray
    """(n,) torque of the motors of the outer side at its wheels [N m]; positive drives forward"""
    inner: FloatArray
    """(n,) of the inner side"""
    outer_speed: FloatArray
    """(n,) speed of the outer wheels [rad/s]"""
    inner_speed: FloatArray
    """(n,) of the inner ones; negative where they turn backward"""
    twist: FloatArray
    """(n, 3) of the body's middle: ahead, left [m/s], yaw rate [rad/s]"""
    forces: Forces
    """of the floor"""
    rolling_loss: FloatArray
    """(n,) power against drag and rolling resistance [W]"""

    @property
    def power(self) -> FloatArray:
        """(n,) mechanical power of both sides [W]; what the inner wheels give back counts as negative."""
        return self.outer * self.outer_speed + self.inner * self.inner_speed

    @property
    def radius(self) -> FloatArray:
        """(n,) radius of the way that the body's middle really takes, positive counter-clockwise [m]."""
        with np.errstate(divide="ignore"):
            return np.asarray(np.hypot(self.twist[:, 0], self.twist[:, 1]) / self.twist[:, 2])


def side_torques(vehicle: Vehicle, terrain: Terrain, radius: ArrayLike, speed: ArrayLike) -> SideTorques:
    """Torques in steady turns of commanded `radius` (n,) [m], counter-clockwise positive, at commanded `speed` [m/s].

    An infinite radius is straight on.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a radius is zero or not a number, a speed is not positive and finite, or the shear law is not known.
    """
    radii, speeds = np.broadcast_arrays(np.atleast_1d(np.asarray(radius, dtype=float)), np.asarray(speed, dtype=float))
    if not ((speeds > 0).all() and np.isfinite(speeds).all()):
        raise ConfigError(f"speed {speeds[~(np.isfinite(speeds) & (speeds > 0))][0]} m/s: give a positive number")
    if np.isnan(radii).any() or (radii == 0).any():
        raise ConfigError("radius: give a number other than zero [m]; inf is straight on")
    commands = np.stack([speeds, speeds / radii], axis=-1)
    rims, shear = vehicle.rims(commands), terrain.known_shear()
    left_out = commands[:, 1] < 0
    outer_mu, inner_mu = np.full(len(radii), shear.mu_outer), np.full(len(radii), shear.mu_inner)
    straight = commands[:, 1] == 0
    outer_mu[straight] = inner_mu[straight] = 0.5 * (shear.mu_outer + shear.mu_inner)
    friction = np.where(left_out[:, None], np.stack([outer_mu, inner_mu], -1), np.stack([inner_mu, outer_mu], -1))
    twist = _balance(vehicle, friction, shear.modulus, rims, commands, terrain.yaw_rates(commands))
    forces = floor_forces(vehicle, friction, shear.modulus, rims, twist)
    traction = forces.traction.reshape(-1, 2, 2).sum(1)
    loads = forces.loads.reshape(-1, 2, 2).sum(1)
    wheel_speeds = rims / vehicle.wheel_radius
    drag = np.sign(rims) * (vehicle.drag_torque + vehicle.rolling_coefficient * vehicle.wheel_radius * loads)
    torque = vehicle.wheel_radius * traction + drag
    pick = np.where(left_out, 0, 1)
    rows = np.arange(len(radii))
    return SideTorques(
        outer=torque[rows, pick],
        inner=torque[rows, 1 - pick],
        outer_speed=wheel_speeds[rows, pick],
        inner_speed=wheel_speeds[rows, 1 - pick],
        twist=twist,
        forces=forces,
        rolling_loss=np.sum(drag * wheel_speeds, axis=-1),
    )


def _balance(
    vehicle: Vehicle,
    friction: FloatArray,
    modulus: float,
    rims: FloatArray,
    commands: FloatArray,
    yaw_rates: FloatArray | None,
) -> FloatArray:
    """(n, 3) twists at which the floor's forces are those that the turn takes; yaw rates given are kept.

    Levenberg-Marquardt for all conditions at once. The stress grows with the sliding: the forces are monotone in the
    twist, and what is found is all that there is.
    """
    count, free = len(rims), 3 if yaw_rates is None else 2
    twist = np.stack([commands[:, 0], np.zeros(count), commands[:, 1] if yaw_rates is None else yaw_rates], axis=-1)
    lever = 0.5 * np.hypot(vehicle.track, vehicle.wheel_base)
    scale = vehicle.weight * np.array([1.0, 1.0, lever])
    # By how much a rim speed is the step of a difference, and the yaw rate so that the wheels move as much.
    reach = np.abs(rims).max(axis=1, keepdims=True) * np.array([1.0, 1.0, 1.0 / lever])

    def missing(motion: FloatArray, rows: NDArray[np.intp]) -> FloatArray:
        forces = floor_forces(vehicle, friction[rows], modulus, rims[rows], motion)
        return np.asarray((forces.wrench - inertial_wrench(vehicle, motion)) / scale)[:, :free]

    every = np.arange(count)
    damping, left = np.full(count, 1e-3), missing(twist, every)
    for _ in range(_ITERATIONS):
        rows = np.flatnonzero(np.abs(left).max(axis=1) > _BALANCED)
        if not rows.size:
            break
        step = 1e-6 * reach[rows]
        moved = np.repeat(twist[rows, None], free, axis=1)
        for i in range(free):
            moved[:, i, i] += step[:, i]
        changed = missing(moved.reshape(-1, 3), np.repeat(rows, free)).reshape(-1, free, free)
        # Columns of the Jacobian, over the reach of each unknown.
        slope = np.moveaxis((changed - left[rows, None]) * 1e6, 1, 2)
        normal = np.swapaxes(slope, 1, 2) @ slope
        grade = np.swapaxes(slope, 1, 2) @ left[rows, :, None]
        normal = (
            normal
            + damping[rows, None, None] * np.eye(free) * (np.trace(normal, axis1=1, axis2=2) / free)[:, None, None]
        )
        move = np.clip(-np.linalg.solve(normal, grade)[..., 0], -0.3, 0.3) * reach[rows, :free]
        tried = twist[rows].copy()
        tried[:, :free] += move
        residual = missing(tried, rows)
        better = np.sum(residual**2, axis=1) < np.sum(left[rows] ** 2, axis=1)
        twist[rows[better]], left[rows[better]] = tried[better], residual[better]
        damping[rows] = np.clip(damping[rows] * np.where(better, 0.2, 5.0), 1e-12, 1e6)
    return twist
