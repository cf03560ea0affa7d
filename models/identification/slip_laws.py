"""What wheels do to a skid-steered body: laws from rim speeds to body twist, with coefficients to be found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from diffdrive_mpc.models.interface import FloatArray


class SlipLaw(Protocol):
    """From wheel rates to body twist."""

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each coefficient."""
        ...

    @property
    def start(self) -> FloatArray:
        """(q,) coefficients of a robot that does not slip."""
        ...

    @property
    def holds_lever_arm(self) -> bool:
        """Whether the coefficients already describe any point fixed to the body, so that it cannot be told apart."""
        ...

    def twist(self, coefficients: FloatArray, wheels: FloatArray) -> FloatArray:
        """(..., 3) v, lateral speed to the left [m/s], yaw rate [rad/s] of wheels (..., 2) left, right [rad/s]."""
        ...


@dataclass(frozen=True)
class ConstantTrack:
    """v and omega as on a differential drive, with a wider track, and side-slip lateral = -side_slip v omega.

    Coefficients: wheel_radius [m], track [m], side_slip [s].

    Attributes
    ----------
    wheel_radius, track
        Of the catalogue, to start from [m].
    """

    wheel_radius: float
    track: float
    names: tuple[str, ...] = ("wheel_radius", "track", "side_slip")
    holds_lever_arm: bool = False

    @property
    def start(self) -> FloatArray:
        """(3,)."""
        return np.array([self.wheel_radius, self.track, 0.0])

    def twist(self, coefficients: FloatArray, wheels: FloatArray) -> FloatArray:
        """(..., 3); see `SlipLaw`."""
        radius, track, side_slip = coefficients
        v = 0.5 * radius * (wheels[..., 0] + wheels[..., 1])
        omega = radius * (wheels[..., 1] - wheels[..., 0]) / track
        return np.stack([v, -side_slip * v * omega, omega], axis=-1)


@dataclass(frozen=True)
class VirtualTrack:
    """The track grows with the yaw rate, i = p1 |yaw rate| + p0, and side-slip as in `ConstantTrack`.

    Source: Botta et al., Appl. Sci. 2021, 11(4), 1594. yaw rate = difference / i is quadratic in the yaw rate; its
    solution that stays finite for p1 = 0 is used. Coefficients: wheel_radius [m], p0 [m], p1 [m s], side_slip [s].

    Attributes
    ----------
    wheel_radius, track
        Of the catalogue, to start from [m].
    """

    wheel_radius: float
    track: float
    names: tuple[str, ...] = ("wheel_radius", "p0", "p1", "side_slip")
    holds_lever_arm: bool = False

    @property
    def start(self) -> FloatArray:
        """(4,)."""
        return np.array([self.wheel_radius, self.track, 0.0, 0.0])

    def twist(self, coefficients: FloatArray, wheels: FloatArray) -> FloatArray:
        """(..., 3); see `SlipLaw`."""
        radius, p0, p1, side_slip = coefficients
        v = 0.5 * radius * (wheels[..., 0] + wheels[..., 1])
        difference = radius * (wheels[..., 1] - wheels[..., 0])
        # Below the root's range the law has no solution; its edge keeps the search finite.
        root = np.sqrt(np.maximum(p0**2 + 4 * p1 * np.abs(difference), 0.0))
        omega = 2 * difference / (p0 + root)
        return np.stack([v, -side_slip * v * omega, omega], axis=-1)


@dataclass(frozen=True)
class SlipPolynomial:
    """v, lateral speed and yaw rate each with terms in v_c, w_c and v_c w_c added to the wheels' (v_c, w_c).

    Source: Ordonez et al. 2017: v = v_c + a11 v_c + a12 w_c + a13 v_c w_c, lateral = a21 v_c + a22 w_c + a23 v_c w_c,
    omega = w_c + a31 v_c + a32 w_c + a33 v_c w_c. Here lateral is to the left and w_c counter-clockwise. A pose point
    away from the rotation centre adds to a12 and a22, so the polynomial is that of the pose point.

    Attributes
    ----------
    wheel_radius, track
        By which (v_c, w_c) are computed [m]; the coefficients belong to them.
    """

    wheel_radius: float
    track: float
    names: tuple[str, ...] = tuple(f"a{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))
    holds_lever_arm: bool = True

    @property
    def start(self) -> FloatArray:
        """(9,)."""
        return np.zeros(9)

    def twist(self, coefficients: FloatArray, wheels: FloatArray) -> FloatArray:
        """(..., 3); see `SlipLaw`."""
        v = 0.5 * self.wheel_radius * (wheels[..., 0] + wheels[..., 1])
        omega = self.wheel_radius * (wheels[..., 1] - wheels[..., 0]) / self.track
        terms = np.stack([v, omega, v * omega], axis=-1)
        return np.asarray(np.stack([v, np.zeros_like(v), omega], axis=-1) + terms @ coefficients.reshape(3, 3).T)
