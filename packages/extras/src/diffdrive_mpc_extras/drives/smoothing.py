"""Kinks and jumps of a drive, as they are and rounded off so that they have derivatives."""

from __future__ import annotations

from typing import Protocol

import casadi as ca

_CORNER = 4
"""Even power of the rounded limit: at the corner it gives 2^(-1/4) = 84 % of the limit."""


class DriveFunctions(Protocol):
    """The functions of which the equations of a drive are made."""

    def limited(self, x: ca.SX) -> ca.SX:
        """X within -1 to 1."""
        ...

    def size(self, x: ca.SX, width: float) -> ca.SX:
        """|x|; `width` is over how much it may be rounded."""
        ...

    def sign(self, x: ca.SX, width: float) -> ca.SX:
        """Sign of x."""
        ...

    def positive(self, x: ca.SX) -> ca.SX:
        """Whether a number in -1 to 1 is positive: its size where it is, else 0."""
        ...

    def exceeds(self, x: ca.SX, width: float) -> ca.SX:
        """1 where x is positive, else 0."""
        ...


class Sharp:
    """As they are; for plants."""

    def limited(self, x: ca.SX) -> ca.SX:
        """See `DriveFunctions`."""
        return ca.fmin(1, ca.fmax(-1, x))

    def size(self, x: ca.SX, width: float) -> ca.SX:  # noqa: ARG002 - nothing is rounded here
        """See `DriveFunctions`."""
        return ca.fabs(x)

    def sign(self, x: ca.SX, width: float) -> ca.SX:  # noqa: ARG002
        """See `DriveFunctions`."""
        return ca.sign(x)

    def positive(self, x: ca.SX) -> ca.SX:
        """See `DriveFunctions`."""
        return ca.fmax(x, 0)

    def exceeds(self, x: ca.SX, width: float) -> ca.SX:  # noqa: ARG002
        """See `DriveFunctions`."""
        return ca.if_else(x > 0, 1, 0)


class Smooth:
    """Rounded off: algebraic limit, |x| as a root, signs and thresholds as tanh; for the controller.

    At zero they have the value and the slope that a robot at rest needs: limit 1, size 0, sign 0.
    """

    def limited(self, x: ca.SX) -> ca.SX:
        """See `DriveFunctions`."""
        return x * (1 + x**_CORNER) ** (-1 / _CORNER)

    def size(self, x: ca.SX, width: float) -> ca.SX:
        """See `DriveFunctions`."""
        return ca.sqrt(x**2 + width**2) - width

    def sign(self, x: ca.SX, width: float) -> ca.SX:
        """See `DriveFunctions`."""
        return ca.tanh(x / width)

    def positive(self, x: ca.SX) -> ca.SX:
        """See `DriveFunctions`."""
        small = 0.05
        return (ca.sqrt(x**2 + small**2) + x - small) / 2

    def exceeds(self, x: ca.SX, width: float) -> ca.SX:
        """See `DriveFunctions`."""
        return (1 + ca.tanh(x / width)) / 2
