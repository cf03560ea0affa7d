"""Torque of the outer and the inner side against turn radius and speed.

Ordonez et al., 2017 (P4), sections 2.2 and 2.3: a command gives wheel speeds by the base's own kinematics and the
motion of the body by the slip law, both together the sliding under the tyres, and that the torque (equation 13).
Details that the paper takes from its references are chosen here:

* **S_o**, how far the centre of the turn lies ahead of the middle, is where the lateral forces of the tyres balance the
  centripetal one.
* **Forward speed** is where the tractions balance. A slip law's forward terms hold errors of the wheel radius, too: the
  printed a11 = 0.015 alone would have both sides of a robot that drives straight on brake it.
* **Yaw rate** is that of the slip law; without one, the one at which the moments balance.
* **F_ri, F_ro** are the drag of the drive train and a rolling coefficient times load, against the wheels' turning.

Forces under the four tyres of a vehicle in a steady turn, by quadrature over their contact patches.

Ordonez et al., 2017 (P4), equations 5 to 12, for all wheels at once and in this project's frame: x ahead, y left,
turning counter-clockwise positive. A point of the tread meets the floor where the patch begins, at its front edge if
the wheel turns forward and at its rear edge if it turns backward, and then goes through it at the rim speed while the
vehicle turns about a fixed centre. Its distance from the place of its first contact is its shear displacement j. In
equation 9 the subtracted term must be the coordinate n_a of the front edge, or j would not begin at zero; the
arctangent (12) does not know the quadrant: here the stress points against the sliding velocity.
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
"""Gauss points along and across a patch: torques are within 1e-4 of those of four times as many (tested)."""

# Rim speeds below this [m/s] are those of a standing wheel: its tread has been in the patch for ever.
_STANDING = 1e-9
# exp(-40) is negligible compared with one.
_SLIDING = 40.0


class Forces(NamedTuple):
    """Forces of the floor on the vehicle for n conditions."""

    traction: FloatArray
    """(n, 4) forward force on each tyre [N]"""
    side: FloatArray
    """(n, 4) force to the left on each [N]"""
    moment: FloatArray
    """(n,) counter-clockwise about the middle between the wheels [N m]"""
    loss: FloatArray
    """(n,) power that sliding turns into heat [W]"""
    loads: FloatArray
    """(n, 4) load of each wheel [N]"""

    @property
    def wrench(self) -> FloatArray:
        """(n, 3) forces ahead and to the left [N], moment about the middle [N m]."""
        return np.stack([self.traction.sum(-1), self.side.sum(-1), self.moment], axis=-1)


def floor_forces(
    vehicle: Vehicle,
    friction: FloatArray,
    modulus: float,
    rims: FloatArray,
    twist: FloatArray,
    nodes: tuple[int, int] = NODES,
) -> Forces:
    """Compute the forces under the tyres.

    Parameters
    ----------
    vehicle
        Vehicle with the loads of the steady turn, with the transfer by its own acceleration.
    friction
        (n, 2) coefficients of friction left, right.
    modulus
        Shear deformation modulus K [m].
    rims
        (n, 2) rim speeds left, right [m/s].
    twist
        (n, 3) of the middle between the wheels: ahead, left [m/s], yaw rate [rad/s].
    nodes
        Gauss points along and across a patch.
    """
    u, w, omega = (component[:, None, None] for component in np.asarray(twist, dtype=float).T)
    dx, dy, weights = _patch(vehicle.patch_length, vehicle.patch_width, nodes)
    x = vehicle.places[:, :1] + dx  # (4, q)
    y = vehicle.places[:, 1:] + dy
    rim = np.asarray(rims, dtype=float)[:, [0, 1, 0, 1], None]  # (n, 4, 1)
    # Sliding velocity of the tread over the floor.
    along, across = u - omega * y - rim, w + omega * x
    backward = rim < 0
    edge = vehicle.places[:, :1] + np.where(backward, -0.5, 0.5) * vehicle.patch_length
    moving = np.maximum(np.abs(rim), _STANDING)
    speed = np.hypot(along, across)
    # Beyond this number of moduli the tread slides at its limit, and its path has no effect on the force.
    duration = np.minimum(np.abs(edge - x) / moving, _SLIDING * modulus / np.maximum(speed, 1e-300))
    displacement = _displacement(u, w, omega, x, y, edge, duration)
    stress = -np.expm1(-displacement / modulus) / np.maximum(speed, 1e-300)
    loads = vehicle.loads(_acceleration(vehicle, twist))
    limit = (np.asarray(friction, dtype=float)[:, [0, 1, 0, 1]] * loads)[..., None] * weights
    ahead, left = -limit * stress * along, -limit * stress * across
    moment = np.sum(x * left - y * ahead, axis=(1, 2))
    loss = -np.sum(ahead * along + left * across, axis=(1, 2))
    return Forces(ahead.sum(-1), left.sum(-1), moment, loss, loads)


def inertial_wrench(vehicle: Vehicle, twist: FloatArray) -> FloatArray:
    """Compute forces [N] and moment about the middle [N m] (n, 3) of a steady turn with `twist` (n, 3)."""
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

    The point went from (edge, y) to (x, y) in the frame of the body, which meanwhile moved by the arc of its twist.
    Equations 8 and 9 are this, written about the centre of the turn; this form holds for a straight way, too.
    """
    turned = omega * duration
    # How far the body's origin went, in its frame at the beginning: sin(a)/a and (1 - cos(a))/a stay finite at zero.
    half = 0.5 * turned
    ratio = np.sinc(half / np.pi)
    sine, rise = np.sinc(turned / np.pi), np.sin(half) * ratio
    origin_x = duration * (u * sine - w * rise)
    origin_y = duration * (u * rise + w * sine)
    # cos(a) - 1 without cancellation.
    fall = -2 * np.sin(half) ** 2
    jx = origin_x + (x - edge) + fall * x - np.sin(turned) * y
    jy = origin_y + fall * y + np.sin(turned) * x
    return np.asarray(np.hypot(jx, jy))


@cache
def _gauss(count: int) -> tuple[FloatArray, FloatArray]:
    points, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * points, 0.5 * weights


def _patch(length: float, width: float, nodes: tuple[int, int]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute offsets (q,) ahead and left [m] of a patch's quadrature points, and weights, which sum to one."""
    (a, by_a), (b, by_b) = _gauss(nodes[0]), _gauss(nodes[1])
    return np.repeat(length * a, len(b)), np.tile(width * b, len(a)), np.outer(by_a, by_b).ravel()


_ITERATIONS = 200
# Balance counts as found when the remaining force over the weight is below this.
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
    """Forces of the floor."""
    rolling_loss: FloatArray
    """(n,) power against drag and rolling resistance [W]"""

    @property
    def power(self) -> FloatArray:
        """(n,) mechanical power of both sides [W]; power that the inner wheels return counts as negative."""
        return self.outer * self.outer_speed + self.inner * self.inner_speed

    @property
    def radius(self) -> FloatArray:
        """(n,) actual radius of the path of the body's middle, positive counter-clockwise [m]."""
        with np.errstate(divide="ignore"):
            return np.asarray(np.hypot(self.twist[:, 0], self.twist[:, 1]) / self.twist[:, 2])


def side_torques(vehicle: Vehicle, terrain: Terrain, radius: ArrayLike, speed: ArrayLike) -> SideTorques:
    """Compute torques in steady turns of commanded `radius` (n,) [m], counter-clockwise positive, at `speed` [m/s].

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
    """Solve for twists (n, 3) at which the floor's forces are those of the turn; given yaw rates are fixed.

    Levenberg-Marquardt for all conditions at once. The stress grows with the sliding: the forces are monotone in the
    twist, so the solution is unique.
    """
    count, free = len(rims), 3 if yaw_rates is None else 2
    twist = np.stack([commands[:, 0], np.zeros(count), commands[:, 1] if yaw_rates is None else yaw_rates], axis=-1)
    lever = 0.5 * np.hypot(vehicle.track, vehicle.wheel_base)
    scale = vehicle.weight * np.array([1.0, 1.0, lever])
    # Step of a difference: a part of the rim speed, and a yaw rate that moves the wheels as much.
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
