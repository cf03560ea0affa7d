"""Slip: the difference between the twist that the velocity model predicts and the actual twist of the body."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray


@dataclass(frozen=True, slots=True)
class Slip:
    """Parameters of slip: offset and gains of the twist, side-slip, and turning point.

    With the default values the body moves exactly as the model predicts.

    The wheels move with v + v_offset and omega_gain omega. The yaw rate of the body is yaw_gain times that of the
    wheels. In the body frame, the turning point is at the distance turn_ahead - load_shift a ahead of the origin, where
    a is the forward acceleration, and at the distance turn_left to the left of the origin. It moves forward at
    longitudinal_gain times the wheels' forward speed, and outward in a turn at side_slip v omega.

    A turning robot also slides by slide_x and slide_y per radian of turn, in the frame of the poses, for instance on a
    slope, where skidding wheels do not resist the downhill force.

    The last five parameters are called curved slip: they make the twist a non-affine function of the model's output,
    and the controller linearises the twist at each sample. The parameters span the nine terms of Ordonez et al., 2017
    (P4), and the virtual track of Botta et al., Appl. Sci. 2021, 11(4), 1594 (P3). `of_polynomial` and `polynomial`
    convert from and to P4.

    Attributes
    ----------
    v_offset
        Difference between the forward speed of the wheels and that of the model [m/s].
    omega_gain
        Ratio of the wheels' yaw rate to that of the model [-].
    longitudinal_gain
        Ratio of the body's forward speed to that of the wheels [-].
    yaw_gain
        Ratio of the body's yaw rate to that of the wheels, relative to the surface of the identification [-].
    side_slip
        Ratio of the body's outward lateral speed to v omega [s].
    turn_ahead, turn_left
        Coordinates of the turning point in the body frame [m]; an off-centre load shifts the point.
    load_shift
        Backward shift of the turning point per forward acceleration, which loads the rear axle [s^2].
    slide_x, slide_y
        Sliding distance per radian of turn, along x and y of the frame of the poses [m/rad]. The component along the
        heading is reduced by a constant factor, see `mpc.problem.formulas.sliding`.
    crab
        Ratio of the body's lateral speed to the left to its forward speed [-]; a21 of P4.
    veer
        Yaw angle per forward wheel distance [rad/m]; a31 of P4.
    forward_coupling, yaw_coupling
        Forward speed [s/rad] and yaw rate [s/m] per product of the wheels' speed and yaw rate; a13 and a33 of P4.
    track_growth
        Relative growth of the track per yaw rate of the body [s/rad]; p1 / p0 of P3.
    """

    v_offset: float = 0.0
    omega_gain: float = 1.0
    longitudinal_gain: float = 1.0
    yaw_gain: float = 1.0
    side_slip: float = 0.0
    turn_ahead: float = 0.0
    turn_left: float = 0.0
    load_shift: float = 0.0
    slide_x: float = 0.0
    slide_y: float = 0.0
    crab: float = 0.0
    veer: float = 0.0
    forward_coupling: float = 0.0
    yaw_coupling: float = 0.0
    track_growth: float = 0.0

    @property
    def flat(self) -> list[float]:
        """(10,) values of the flat slip parameters, in the order of `FLAT_SLIPS`."""
        return [getattr(self, name) for name in FLAT_SLIPS]

    @classmethod
    def of_polynomial(cls, coefficients: ArrayLike) -> Slip:
        """Compute the slip from the coefficients (9,) of `models.slip_laws.polynomial_twist`."""
        (a11, a12, a13), (a21, a22, a23), (a31, a32, a33) = np.reshape(np.asarray(coefficients, dtype=float), (3, 3))
        forward, turning = 1 + a11, 1 + a32
        # Side-slip depends on the body's twist. For the term a23 v_c w_c, the affine twist is v = forward v_c + a12 w_c
        # and omega = turning w_c.
        return cls(
            longitudinal_gain=forward,
            yaw_gain=turning,
            side_slip=-a23 / (forward * turning),
            turn_ahead=-a22 / turning,
            turn_left=a12 / turning,
            crab=a21 / forward,
            veer=a31,
            forward_coupling=a13,
            yaw_coupling=a33,
        )

    @property
    def polynomial(self) -> FloatArray:
        """(9,) equivalent coefficients of `models.slip_laws.polynomial_twist`, row by row.

        Offset, load shift, slide and track growth have no equivalent and are omitted. The products of side-slip and
        a12, which are lateral terms in w_c^2, are also omitted.
        """
        turning = self.omega_gain * self.yaw_gain
        return np.array(
            [
                *(self.longitudinal_gain - 1, self.turn_left * turning, self.forward_coupling),
                self.crab * self.longitudinal_gain,
                self.crab * self.turn_left * turning - self.turn_ahead * turning,
                -self.side_slip * self.longitudinal_gain * turning,
                *(self.veer, turning - 1, self.yaw_coupling),
            ]
        )

    @property
    def polynomial_gradient(self) -> FloatArray:
        """(9, 15) gradient of `polynomial` by the slip parameters, in the order of `SLIPS`."""
        # Each coefficient is affine in each parameter, so the difference over a unit step is the exact derivative.
        columns = [replace(self, **{name: getattr(self, name) + 1.0}).polynomial for name in SLIPS]
        return np.stack(columns, axis=1) - self.polynomial[:, None]

    @property
    def gains(self) -> FloatArray:
        """(2,) ratios of the forward speed and yaw rate of the body to those of the model."""
        return np.array([self.longitudinal_gain, self.omega_gain * self.yaw_gain])

    @property
    def offset(self) -> FloatArray:
        """(2,) offset that is added to the model's twist before the gains [m/s, rad/s]."""
        return np.array([self.v_offset, 0.0])


SLIPS: tuple[str, ...] = tuple(field.name for field in fields(Slip))
"""Names of the slip parameters, in the order of the filter's state."""
PRIORS: tuple[str, ...] = tuple(name.removesuffix("_x").removesuffix("_y") for name in SLIPS)
"""Name of the prior of each slip parameter in the configuration; both directions of the slide share one prior."""
CURVED_SLIPS = SLIPS[10:]
"""Slip parameters that make the twist non-affine; the filter has these states only if one is set or estimated."""
FLAT_SLIPS = SLIPS[:10]
"""Slip parameters for which the twist is affine in the model's output."""
