"""Torques of the outer and inner side of a skid-steer vehicle in steady turns, from the shear under its tyres.

Ordonez et al., 2017 (P4), sections 2.2 and 2.3: the kinematics of the base map a command to wheel speeds, and the slip
law maps it to the motion of the body. Both give the sliding velocities under the tyres, and these the torques
(equation 13). The paper takes some details from its references; they are chosen here as follows:

* **S_o**, the longitudinal offset of the centre of the turn, follows from the balance of lateral tyre forces and
  centripetal force.
* **Forward speed** follows from the balance of tractions. The forward terms of a slip law contain errors of the wheel
  radius: with the printed a11 = 0.015, both sides of a robot on a straight path would brake.
* **Yaw rate** follows from the slip law, or without a slip law from the balance of moments.
* **F_ri, F_ro** are the drag of the drive train plus a rolling coefficient times load, against the wheel rotation.

The forces under the four tyres are quadratures over the contact patches: equations 5 to 12 for all wheels at once, in
the body frame of this project (x forward, y left, rotation counter-clockwise). A point of the tread first touches the
ground at the leading edge of the patch: the front edge if the wheel turns forward, the rear edge if it turns backward.
It then moves through the patch at the rim speed while the vehicle turns about a fixed centre. Its distance from the
point of first contact is the shear displacement j. Two corrections of the paper: in equation 9 the subtracted term must
be the coordinate n_a of the front edge, so that j starts at zero; the arctangent of equation 12 loses the quadrant, so
the stress here is opposite to the sliding velocity.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.terrain.terrain_file import Terrain
from diffdrive_mpc_extras.turn_costs.vehicle import Vehicle

NODES = (16, 3)
"""Gauss points along and across a patch; a test compares the torques with four times as many points (1e-4)."""

_MIN_RIM_SPEED = 1e-9
"""Rim speed below which a wheel counts as standing [m/s]."""
_MAX_MODULI = 40.0
"""Sliding distance over the shear modulus at which the stress is at its limit: exp(-40) is negligible."""


class Forces(NamedTuple):
    """Forces of the ground on the vehicle under n conditions."""

    traction: FloatArray
    """Forward force (n, 4) on each tyre [N]"""
    side: FloatArray
    """Force to the left (n, 4) on each tyre [N]"""
    moment: FloatArray
    """Moment (n,) about the centre of the wheels, counter-clockwise [N m]"""
    loss: FloatArray
    """Power (n,) that sliding dissipates [W]"""
    loads: FloatArray
    """Load (n, 4) of each wheel [N]"""

    @property
    def wrench(self) -> FloatArray:
        """Force (n, 3) forward and to the left [N], and moment about the centre of the wheels [N m]."""
        return np.stack([self.traction.sum(-1), self.side.sum(-1), self.moment], axis=-1)


def ground_forces(
    vehicle: Vehicle,
    friction: FloatArray,
    modulus: float,
    rim_speeds: FloatArray,
    twist: FloatArray,
    nodes: tuple[int, int] = NODES,
) -> Forces:
    """Compute the forces under the tyres in steady turns, with the load transfer by the acceleration.

    Parameters
    ----------
    vehicle
        Vehicle.
    friction
        (n, 2) coefficients of friction of the left and right wheels [-].
    modulus
        Shear deformation modulus K [m].
    rim_speeds
        (n, 2) rim speeds of the left and right wheels [m/s].
    twist
        (n, 3) twist of the centre of the wheels: forward, left [m/s], yaw rate [rad/s].
    nodes
        Gauss points along and across a patch.
    """
    u, w, omega = (component[:, None, None] for component in np.asarray(twist, dtype=float).T)
    dx, dy, weights = _patch(vehicle.patch_length, vehicle.patch_width, nodes)
    x = vehicle.wheel_positions[:, :1] + dx  # (4, q)
    y = vehicle.wheel_positions[:, 1:] + dy
    rim = np.asarray(rim_speeds, dtype=float)[:, [0, 1, 0, 1], None]  # (n, 4, 1)
    # Sliding velocity of the tread relative to the ground.
    forward, left = u - omega * y - rim, w + omega * x
    is_backward = rim < 0
    edge = vehicle.wheel_positions[:, :1] + np.where(is_backward, -0.5, 0.5) * vehicle.patch_length
    rim_magnitude = np.maximum(np.abs(rim), _MIN_RIM_SPEED)
    speed = np.hypot(forward, left)
    # After this sliding distance the stress is at its limit, and a longer contact has no effect.
    duration = np.minimum(np.abs(edge - x) / rim_magnitude, _MAX_MODULI * modulus / np.maximum(speed, 1e-300))
    displacement = _displacement(u, w, omega, x, y, edge, duration)
    stress = -np.expm1(-displacement / modulus) / np.maximum(speed, 1e-300)
    loads = vehicle.loads(_acceleration(vehicle, twist))
    limit = (np.asarray(friction, dtype=float)[:, [0, 1, 0, 1]] * loads)[..., None] * weights
    traction, side = -limit * stress * forward, -limit * stress * left
    moment = np.sum(x * side - y * traction, axis=(1, 2))
    loss = -np.sum(traction * forward + side * left, axis=(1, 2))
    return Forces(traction.sum(-1), side.sum(-1), moment, loss, loads)


def inertial_wrench(vehicle: Vehicle, twist: FloatArray) -> FloatArray:
    """Compute the wrench (n, 3) [N, N, N m] that accelerates the vehicle in a steady turn with `twist` (n, 3)."""
    ahead, left, _ = vehicle.centre_of_mass
    force = vehicle.mass * _acceleration(vehicle, twist)
    return np.stack([force[:, 0], force[:, 1], ahead * force[:, 1] - left * force[:, 0]], axis=-1)


def _acceleration(vehicle: Vehicle, twist: FloatArray) -> FloatArray:
    """Compute the acceleration (n, 2) of the centre of mass in a steady turn [m/s^2]."""
    u, w, omega = np.asarray(twist, dtype=float).T
    ahead, left, _ = vehicle.centre_of_mass
    return np.stack([-omega * (w + omega * ahead), omega * (u - omega * left)], axis=-1)


def _displacement(
    u: FloatArray,
    w: FloatArray,
    omega: FloatArray,
    x: FloatArray,
    y: FloatArray,
    edge: FloatArray,
    duration: FloatArray,
) -> FloatArray:
    """Compute the displacement (n, 4, q) of a tread point from its first contact [m]; equations 8 to 10.

    The point moves from (edge, y) to (x, y) in the body frame, while the body moves along the arc of its twist.
    Equations 8 and 9 express the same relative to the centre of the turn; this form is also valid on a straight path.
    """
    angle = omega * duration
    # Displacement of the body's origin in its initial frame; sin(a)/a and (1 - cos(a))/a are finite at zero.
    half = 0.5 * angle
    sin_ratio, cos_ratio = np.sinc(angle / np.pi), np.sin(half) * np.sinc(half / np.pi)
    origin_x = duration * (u * sin_ratio - w * cos_ratio)
    origin_y = duration * (u * cos_ratio + w * sin_ratio)
    # cos(a) - 1 without cancellation.
    cos_minus_one = -2 * np.sin(half) ** 2
    jx = origin_x + (x - edge) + cos_minus_one * x - np.sin(angle) * y
    jy = origin_y + cos_minus_one * y + np.sin(angle) * x
    return np.asarray(np.hypot(jx, jy))


@cache
def _gauss(count: int) -> tuple[FloatArray, FloatArray]:
    points, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * points, 0.5 * weights


def _patch(length: float, width: float, nodes: tuple[int, int]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute offsets (q,) forward and left [m] of the quadrature points of a patch, and weights with sum one."""
    (a, weights_a), (b, weights_b) = _gauss(nodes[0]), _gauss(nodes[1])
    return np.repeat(length * a, len(b)), np.tile(width * b, len(a)), np.outer(weights_a, weights_b).ravel()


_MAX_ITERATIONS = 200
_FORCE_TOLERANCE = 1e-7
"""Remaining force over the weight below which forces count as balanced [-]."""


class SideTorques(NamedTuple):
    """Torques in steady turns under n conditions; the left side is the outer one in clockwise turns."""

    outer: FloatArray
    """Motor torque (n,) of the outer side at its wheels [N m]; positive drives forward"""
    inner: FloatArray
    """Motor torque (n,) of the inner side [N m]"""
    outer_speed: FloatArray
    """Speed (n,) of the outer wheels [rad/s]"""
    inner_speed: FloatArray
    """Speed (n,) of the inner wheels [rad/s]; negative if they turn backward"""
    twist: FloatArray
    """Twist (n, 3) of the centre of the wheels: forward, left [m/s], yaw rate [rad/s]"""
    forces: Forces
    """Forces of the ground"""
    rolling_loss: FloatArray
    """Power (n,) against drag and rolling resistance [W]"""

    @property
    def power(self) -> FloatArray:
        """Mechanical power (n,) of both sides [W]; power that inner wheels return is negative."""
        return self.outer * self.outer_speed + self.inner * self.inner_speed

    @property
    def radius(self) -> FloatArray:
        """Radius (n,) of the path of the centre of the wheels, counter-clockwise positive [m]."""
        with np.errstate(divide="ignore"):
            return np.asarray(np.hypot(self.twist[:, 0], self.twist[:, 1]) / self.twist[:, 2])


def side_torques(vehicle: Vehicle, terrain: Terrain, radius: ArrayLike, speed: ArrayLike) -> SideTorques:
    """Compute torques in steady turns of commanded `radius` (n,) [m], counter-clockwise positive, at `speed` [m/s].

    An infinite radius is a straight path.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a radius is zero or NaN, a speed is not positive and finite, or the shear law is unknown.
    """
    radii, speeds = np.broadcast_arrays(np.atleast_1d(np.asarray(radius, dtype=float)), np.asarray(speed, dtype=float))
    if not ((speeds > 0).all() and np.isfinite(speeds).all()):
        raise ConfigError(f"speed {speeds[~(np.isfinite(speeds) & (speeds > 0))][0]} m/s: use a positive number")
    if np.isnan(radii).any() or (radii == 0).any():
        raise ConfigError("radius: use a number other than zero [m]; inf is a straight path")
    commands = np.stack([speeds, speeds / radii], axis=-1)
    rim_speeds, shear = vehicle.rim_speeds(commands), terrain.known_shear()
    is_left_outer = commands[:, 1] < 0
    outer_mu, inner_mu = np.full(len(radii), shear.mu_outer), np.full(len(radii), shear.mu_inner)
    is_straight = commands[:, 1] == 0
    outer_mu[is_straight] = inner_mu[is_straight] = 0.5 * (shear.mu_outer + shear.mu_inner)
    friction = np.where(is_left_outer[:, None], np.stack([outer_mu, inner_mu], -1), np.stack([inner_mu, outer_mu], -1))
    twist = _balance(vehicle, friction, shear.modulus, rim_speeds, commands, terrain.yaw_rates(commands))
    forces = ground_forces(vehicle, friction, shear.modulus, rim_speeds, twist)
    traction = forces.traction.reshape(-1, 2, 2).sum(1)
    loads = forces.loads.reshape(-1, 2, 2).sum(1)
    wheel_speeds = rim_speeds / vehicle.wheel_radius
    drag = np.sign(rim_speeds) * (vehicle.drag_torque + vehicle.rolling_coefficient * vehicle.wheel_radius * loads)
    torque = vehicle.wheel_radius * traction + drag
    outer_column = np.where(is_left_outer, 0, 1)
    rows = np.arange(len(radii))
    return SideTorques(
        outer=torque[rows, outer_column],
        inner=torque[rows, 1 - outer_column],
        outer_speed=wheel_speeds[rows, outer_column],
        inner_speed=wheel_speeds[rows, 1 - outer_column],
        twist=twist,
        forces=forces,
        rolling_loss=np.sum(drag * wheel_speeds, axis=-1),
    )


def _balance(
    vehicle: Vehicle,
    friction: FloatArray,
    modulus: float,
    rim_speeds: FloatArray,
    commands: FloatArray,
    yaw_rates: FloatArray | None,
) -> FloatArray:
    """Solve for the twists (n, 3) at which ground forces and inertial forces balance, optionally for fixed yaw rates.

    Levenberg-Marquardt for all conditions at once. The stress increases with the sliding velocity, so the forces are
    monotone in the twist and the solution is unique.
    """
    count, free = len(rim_speeds), 3 if yaw_rates is None else 2
    twist = np.stack([commands[:, 0], np.zeros(count), commands[:, 1] if yaw_rates is None else yaw_rates], axis=-1)
    lever = 0.5 * np.hypot(vehicle.track, vehicle.wheel_base)
    scale = vehicle.weight * np.array([1.0, 1.0, lever])
    # Scale of each unknown: the rim speed, and a yaw rate that moves the wheels at the same speed.
    unit = np.abs(rim_speeds).max(axis=1, keepdims=True) * np.array([1.0, 1.0, 1.0 / lever])

    def imbalance(motion: FloatArray, rows: NDArray[np.intp]) -> FloatArray:
        forces = ground_forces(vehicle, friction[rows], modulus, rim_speeds[rows], motion)
        return np.asarray((forces.wrench - inertial_wrench(vehicle, motion)) / scale)[:, :free]

    damping, residual = np.full(count, 1e-3), imbalance(twist, np.arange(count))
    for _ in range(_MAX_ITERATIONS):
        rows = np.flatnonzero(np.abs(residual).max(axis=1) > _FORCE_TOLERANCE)
        if not rows.size:
            break
        step = 1e-6 * unit[rows]
        shifted = np.repeat(twist[rows, None], free, axis=1)
        for i in range(free):
            shifted[:, i, i] += step[:, i]
        shifted_residual = imbalance(shifted.reshape(-1, 3), np.repeat(rows, free)).reshape(-1, free, free)
        jacobian = np.moveaxis((shifted_residual - residual[rows, None]) * 1e6, 1, 2)
        normal = np.swapaxes(jacobian, 1, 2) @ jacobian
        gradient = np.swapaxes(jacobian, 1, 2) @ residual[rows, :, None]
        normal = (
            normal
            + damping[rows, None, None] * np.eye(free) * (np.trace(normal, axis1=1, axis2=2) / free)[:, None, None]
        )
        change = np.clip(-np.linalg.solve(normal, gradient)[..., 0], -0.3, 0.3) * unit[rows, :free]
        candidate = twist[rows].copy()
        candidate[:, :free] += change
        new_residual = imbalance(candidate, rows)
        is_better = np.sum(new_residual**2, axis=1) < np.sum(residual[rows] ** 2, axis=1)
        twist[rows[is_better]], residual[rows[is_better]] = candidate[is_better], new_residual[is_better]
        damping[rows] = np.clip(damping[rows] * np.where(is_better, 0.2, 5.0), 1e-12, 1e6)
    return twist
