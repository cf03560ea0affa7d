"""Forces under the four tyres of a vehicle in a steady turn, by quadrature over their contact patches.

Ordonez et al., 2017 (P4), equations 5 to 12, for all wheels at once and in this project's frame: x ahead, y left,
turning counter-clockwise positive. A point of the tread meets the floor where the patch begins, at its front edge if
the wheel turns forward and at its rear edge if it turns backward, and then goes through it at the rim speed while the
vehicle turns about a fixed centre. How far it is from where it met the floor is its shear displacement j. In equation 9
the subtracted term has to be the coordinate n_a of the front edge, or j would not begin at zero; the arctangent (12)
does not know the quadrant: here the stress points against the sliding velocity.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.turn_costs.vehicle import Vehicle

NODES = (16, 3)
"""Gauss points along and across a patch: torques are within 1e-4 of those of four times as many (tested)."""

# Rim speeds below this [m/s] are those of a wheel that stands: its tread has been in the patch for ever.
_STANDING = 1e-9
# exp(-40) is nothing beside one.
_SLIDING = 40.0


class Forces(NamedTuple):
    """What the floor does to the vehicle, n conditions."""

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
    """Forces under the tyres.

    Parameters
    ----------
    vehicle
        Its loads are those of the steady turn, with the transfer by its own acceleration.
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
    u, w, omega = (one[:, None, None] for one in np.asarray(twist, dtype=float).T)
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
    # Past so many moduli the tread slides at its limit, and no way round brings that back.
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
    """(n, 3) forces [N] and moment about the middle [N m] that a steady turn with `twist` (n, 3) takes."""
    ahead, left, _ = vehicle.centre_of_mass
    force = vehicle.mass * _acceleration(vehicle, twist)
    return np.stack([force[:, 0], force[:, 1], ahead * force[:, 1] - left * force[:, 0]], axis=-1)


def _acceleration(vehicle: Vehicle, twist: FloatArray) -> FloatArray:
    """(n, 2) of the centre of mass in a steady turn [m/s^2]."""
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
    """(n, 4, q) how far a point of the tread is from where it met the floor [m]; equations 8 to 10.

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
    """(q,) offsets ahead and left [m] of the quadrature points of a patch, and their weights, which add up to one."""
    (a, by_a), (b, by_b) = _gauss(nodes[0]), _gauss(nodes[1])
    return np.repeat(length * a, len(b)), np.tile(width * b, len(a)), np.outer(by_a, by_b).ravel()
