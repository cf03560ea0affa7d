"""Slip: the difference between the twist that the velocity model predicts and the twist of the body on its surface."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray


@dataclass(frozen=True, slots=True)
class Slip:
    """Offset and gains of a twist, side-slip and turning point; with the defaults the robot follows its model exactly.

    The wheels move with v + v_offset and omega_gain omega. The body turns with yaw_gain times the wheels' yaw rate
    about a point that lies (turn_ahead - load_shift times the forward acceleration) ahead of the origin of the body
    frame and turn_left to its left. This point moves with longitudinal_gain times the wheels' forward speed, and
    outward in a turn with side_slip v omega.

    A turning robot also slides in the plane of the floor, by slide_x and slide_y per radian in the frame of the poses:
    on a slope, skidding wheels no longer resist the downhill force.

    The last five slips are called curved: they make the twist non-affine in the model's output, and the controller
    linearises it at each sample. All slips together span the nine terms of Ordonez et al., 2017 (P4), and the virtual
    track of Botta et al., Appl. Sci. 2021, 11(4), 1594 (P3); `of_polynomial` and `polynomial` convert from and to P4.

    Attributes
    ----------
    v_offset
        Forward speed of the wheels that the model does not explain [m/s].
    omega_gain
        Yaw rate of the wheels over that of the model [-].
    longitudinal_gain
        Forward speed of the body over that of the wheels [-].
    yaw_gain
        Yaw rate of the body over that of the wheels, relative to the surface on which the model was identified [-].
    side_slip
        Lateral speed of the body, outward, over v omega [s].
    turn_ahead, turn_left
        Point about which the robot turns, in the body frame [m]; an off-centre load shifts it.
    load_shift
        Distance that the turning point moves back per unit of forward acceleration, which loads the rear axle [s^2].
    slide_x, slide_y
        Distance that the robot slides per radian of turn, along x and y of the frame of the poses [m/rad]: the full
        component across the heading, and a share of the component along it (`mpc.problem.formulas.sliding`).
    crab
        Lateral speed of the body, to the left, over its forward speed [-]; P4's a21.
    veer
        Yaw for each metre that the wheels drive forward [rad/m]; P4's a31.
    forward_coupling, yaw_coupling
        Forward speed [s/rad] and yaw rate [s/m] for the product of the wheels' speed and yaw rate; P4's a13, a33.
    track_growth
        Relative growth of the track for each rad/s of the body's yaw rate [s/rad]; P3's p1 / p0.
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
        """(10,) values of the flat slips, in the order of `FLAT_SLIPS`."""
        return [getattr(self, name) for name in FLAT_SLIPS]

    @classmethod
    def of_polynomial(cls, coefficients: ArrayLike) -> Slip:
        """Compute the slip of a surface with these nine coefficients (9,) of `models.slip_laws.polynomial_twist`."""
        (a11, a12, a13), (a21, a22, a23), (a31, a32, a33) = np.reshape(np.asarray(coefficients, dtype=float), (3, 3))
        forward, turning = 1 + a11, 1 + a32
        # a23 v_c w_c is written in the affine twist, v = forward v_c + a12 w_c and omega = turning w_c.
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

        Offset, load shift, slide and track growth have no equivalent and are omitted; so are lateral terms in w_c^2,
        the products of side-slip and a12.
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
        """(9, 15) gradient of `polynomial` by the slips, in the order of `SLIPS`."""
        # Each coefficient is linear in each slip, so a difference over a unit step is exact.
        columns = [replace(self, **{name: getattr(self, name) + 1.0}).polynomial for name in SLIPS]
        return np.stack(columns, axis=1) - self.polynomial[:, None]

    @property
    def gains(self) -> FloatArray:
        """(2,) forward speed and yaw rate of the body over those of the model."""
        return np.array([self.longitudinal_gain, self.omega_gain * self.yaw_gain])

    @property
    def offset(self) -> FloatArray:
        """(2,) offset of the model's twist before the gains [m/s, rad/s]."""
        return np.array([self.v_offset, 0.0])


SLIPS: tuple[str, ...] = tuple(field.name for field in fields(Slip))
"""Names of the slips, in the order of the filter's state."""
PRIORS: tuple[str, ...] = tuple(name.removesuffix("_x").removesuffix("_y") for name in SLIPS)
"""Name of each slip's prior in the configuration; both directions of the slide share one prior."""
CURVED_SLIPS = SLIPS[10:]
"""Slips that make the twist non-affine; the filter has these states only if the configuration sets or estimates one."""
FLAT_SLIPS = SLIPS[:10]
"""Slips for which the twist is affine in the model's output."""
