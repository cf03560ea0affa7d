"""File of the turns of one robot on one floor, for planner, controller and studies.

Torque of the sides over signed curvature as one smooth curve, the same for numbers and for CasADi.

A turn to the left takes the right side as the outer one, a turn to the right as the inner one; backward all torques
change their signs. So with the mean m and half the difference d of outer and inner side, both without the drag of
the drive train, the right side has sign(v) m(k) + d(k) and the left one sign(v) m(k) - d(k), m even and d odd in the
curvature k: P is even at straight on, and smooth. The drag turns with the wheel, so it changes its sign where the
inner wheels begin to turn backward.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self

import casadi as ca
import numpy as np
import yaml
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, Field, model_validator
from scipy.interpolate import PchipInterpolator, make_lsq_spline

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.named_file import named_file
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc.models.slip_laws import POLYNOMIAL, polynomial_twist
from diffdrive_mpc_extras.turn_costs.vehicle import (
    DRIVES,
    VEHICLES,
    NamedDrive,
    Vehicle,
    load_drive_constants,
    load_vehicle,
)

LIMIT_SHARE = 0.95
"""Share of the torque limit that counts as reached; Ordonez et al., 2017 (P4), section 4.2."""

_PER_DECADE = 60


def least_radius(
    outer_torque: Callable[[FloatArray], ArrayLike],
    limit: float,
    radii: tuple[float, float] = (0.05, 1000.0),
    share: float = LIMIT_SHARE,
) -> float:
    """Find the largest radius at which the outer side needs more than `share` of its limit [m]; 0 without one.

    Parameters
    ----------
    outer_torque
        Torque of the outer side [N m] at radii (n,) [m]; of a model, a network or a table.
    limit
        Largest torque of a side [N m].
    radii
        Smallest and largest radius [m].
    share
        Share of the limit.

    Returns
    -------
    float
        The radius; infinity where even the widest turn needs more.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the limit is not a positive number, or a torque not finite.
    """
    if not (math.isfinite(limit) and limit > 0):
        raise ConfigError(f"torque limit {limit} N m: give a positive number")
    low, high = np.log10(radii)
    grid = np.logspace(low, high, max(2, round((high - low) * _PER_DECADE)))
    torque = np.abs(np.asarray(outer_torque(grid), dtype=float))
    if not np.isfinite(torque).all():
        raise ConfigError("the torque is not finite at some radius; no least radius follows from it")
    over = np.flatnonzero(torque > share * limit)
    if not over.size:
        return 0.0
    last = int(over[-1])
    if last == len(grid) - 1:
        return math.inf
    inside, outside = grid[last], grid[last + 1]
    for _ in range(40):
        middle = math.sqrt(inside * outside)
        too_much = abs(float(np.asarray(outer_torque(np.array([middle])))[0])) > share * limit
        inside, outside = (middle, outside) if too_much else (inside, middle)
    return float(math.sqrt(inside * outside))


_DEGREE = 3
_INTERVALS = 36
_DENSE = 60
# Curvature at which the scale goes from linear to logarithmic [1/m].
_BEND = 0.05


class TorqueSpline:
    """Cubic splines through a table over asinh of the curvature, held beyond its ends.

    Parameters
    ----------
    curvature
        (n,) ascending, positive [1/m].
    mean
        (n,) half the sum of outer and inner traction torque [N m].
    difference
        (n,) half their difference [N m].
    """

    def __init__(self, curvature: ArrayLike, mean: ArrayLike, difference: ArrayLike) -> None:
        scaled = np.arcsinh(np.asarray(curvature, dtype=float) / _BEND)
        self._most = float(scaled[-1])
        self._width = 2 * self._most / _INTERVALS
        self._knots = self._most * np.linspace(-1, 1, _INTERVALS + 1)
        outside = self._width * np.arange(1, _DEGREE + 1)
        knots = np.concatenate([-self._most - outside[::-1], self._knots, self._most + outside])
        dense = np.linspace(-self._most, self._most, _DENSE * _INTERVALS + 1)
        self._splines = []
        for values, odd in ((mean, False), (difference, True)):
            torques = np.asarray(values, dtype=float)
            # Straight on there is no difference, and the mean is that of the widest turn.
            table = PchipInterpolator(np.append(0.0, scaled), np.append(0.0 if odd else torques[0], torques))
            whole = table(np.abs(dense)) * (np.sign(dense) if odd else 1.0)
            self._splines.append(make_lsq_spline(dense, whole, knots, k=_DEGREE))

    def __call__(self, curvature: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute mean and half difference [N m] at signed curvatures (n,) [1/m]."""
        scaled = np.clip(np.arcsinh(curvature / _BEND), -self._most, self._most)
        mean, difference = (np.asarray(spline(scaled)) for spline in self._splines)
        return mean, difference

    def symbolic(self, curvature: Any) -> tuple[Any, Any]:  # noqa: ANN401 - SX or MX
        """Build the same CasADi expressions, with continuous second derivatives except at the ends of the table."""
        scaled = ca.fmax(-self._most, ca.fmin(self._most, ca.asinh(curvature / _BEND)))
        # Uniform B-splines as cubes of the distance beyond each knot: no cases, so derivatives are valid everywhere.
        binomial = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6.0
        weights = [np.convolve(spline.c, binomial) for spline in self._splines]
        mean: Any = 0.0
        difference: Any = 0.0
        for k, knot in enumerate(self._splines[0].t):
            if knot < self._most:
                beyond = ca.fmax(0.0, (scaled - knot) / self._width)
                cube = beyond * beyond * beyond
                mean, difference = mean + weights[0][k] * cube, difference + weights[1][k] * cube
        return mean, difference


FLOORS = Path(__file__).parent / "floors"
# Over which the sign of a speed goes from one to the other in a symbolic expression [m/s], and powers [W].
_SOFT_SPEED, _SOFT_POWER = 0.01, 0.05
_RADII = (0.05, 1000.0)


def _vehicle(value: Any) -> Any:  # noqa: ANN401 - what a file holds there
    return load_vehicle(value) if isinstance(value, str) else value


class SlipCoefficients(StrictModel):
    """`models.slip_laws.polynomial_twist`: value that is added to commands; lateral is to the left."""

    a11: float = Field(default=0.0, description="forward speed over v_c [-]")
    a12: float = Field(default=0.0, description="forward speed over w_c [m]")
    a13: float = Field(default=0.0, description="forward speed over v_c w_c [s]")
    a21: float = Field(default=0.0, description="lateral speed over v_c [-]")
    a22: float = Field(default=0.0, description="lateral speed over w_c [m]")
    a23: float = Field(default=0.0, description="lateral speed over v_c w_c [s]")
    a31: float = Field(default=0.0, description="yaw rate over v_c [1/m]")
    a32: float = Field(default=0.0, description="yaw rate over w_c [-]")
    a33: float = Field(default=0.0, description="yaw rate over v_c w_c [s/m]")

    @property
    def rows(self) -> FloatArray:
        """(3, 3)."""
        return np.array([getattr(self, name) for name in POLYNOMIAL]).reshape(3, 3)

    @classmethod
    def from_rows(cls, rows: ArrayLike) -> Self:
        """Build from nine numbers row by row; raise ConfigError for anything else."""
        values = np.asarray(rows, dtype=float).ravel()
        if values.shape != (9,) or not np.isfinite(values).all():
            raise ConfigError(f"slip of shape {np.shape(rows)}: give nine finite numbers, a11 to a33 row by row")
        return cls.model_validate(dict(zip(POLYNOMIAL, values.tolist(), strict=True)))


class TorqueTable(StrictModel):
    """Torques of steady turns; beyond its ends they are held."""

    radius: Annotated[tuple[Positive, ...], Field(min_length=3)] = Field(description="commanded, ascending [m]")
    outer: Annotated[tuple[float, ...], Field(min_length=3)] = Field(description="torque of the outer side [N m]")
    inner: Annotated[tuple[float, ...], Field(min_length=3)] = Field(description="torque of the inner side [N m]")
    speed: Positive = Field(description="at which the table stands [m/s]")
    speed_exponent: float = Field(
        ge=0.0, le=1.0, description="a turn at speed v counts as one of radius R (speed / v)^exponent [-]"
    )

    @model_validator(mode="after")
    def _of_one_length(self) -> Self:
        if not len(self.radius) == len(self.outer) == len(self.inner):
            raise ValueError(
                f"{len(self.radius)} radii, {len(self.outer)} outer and {len(self.inner)} inner torques: give as many "
                "of each"
            )
        if not (np.diff(self.radius) > 0).all():
            raise ValueError("radius: has to ascend")
        return self


class TurnCosts(StrictModel):
    """One robot on one floor.

    Values beyond the table are those at its ends: sharper turns than were driven, where the motors are at their limit
    or the tyres slide, have the cost of the sharpest one.
    """

    name: str = Field(min_length=1)
    vehicle: Annotated[Vehicle, BeforeValidator(_vehicle, json_schema_input_type=Vehicle | str)] = Field(
        description="a mapping, or the name of a vehicle file"
    )
    drive: NamedDrive = Field(description="a mapping, or the name of a drive file")
    slip: SlipCoefficients = Field(default_factory=SlipCoefficients, description="without: none")
    curve: TorqueTable
    provenance: str = Field(min_length=1, description="where these values come from")

    def with_idle_power(self, power: float) -> Self:
        """Return the same robot with `power` [W] drawn at rest by computer, sensors and drivers.

        Raises ConfigError if that is no number of watts.
        """
        if not (np.isfinite(power) and power >= 0):
            raise ConfigError(f"idle power {power} W: give zero or a positive number")
        drive = self.drive.model_copy(update={"idle_power": float(power)})
        return self.model_copy(update={"drive": drive})

    def torques(self, commands: ArrayLike) -> FloatArray:
        """Compute torques left, right (n, 2) [N m] in steady turns under commands (n, 2) v [m/s], omega [rad/s].

        Within the torque limit.
        """
        rows = np.asarray(commands, dtype=float)
        v, omega = np.moveaxis(rows, -1, 0)
        mean, difference = self._spline(self._curvature(v, omega))
        sides = (np.sign(v) * mean)[..., None] + difference[..., None] * np.array([-1.0, 1.0])
        rolling = self.vehicle.drag_torque * np.sign(self.vehicle.rims(rows))
        limit = self.vehicle.torque_limit
        return np.asarray(np.clip(sides + rolling, -limit, limit))

    def power(self, commands: ArrayLike) -> FloatArray:
        """Compute the battery power (n,) [W] under commands (n, 2) v [m/s], omega [rad/s], idle power included."""
        rows = np.asarray(commands, dtype=float)
        return self.drive.robot_power(self.torques(rows), self.vehicle.rims(rows) / self.vehicle.wheel_radius)

    def twist(self, commands: ArrayLike) -> FloatArray:
        """Compute forward, lateral speed to the left [m/s], yaw rate [rad/s] (n, 3) of the body, by the slip law."""
        return polynomial_twist(self.slip.rows, commands)

    def command(self, v: ArrayLike, omega: ArrayLike) -> FloatArray:
        """Compute commands (..., 2) whose body twist has this v [m/s] and omega [rad/s].

        Raises ConfigError where the slip law has no such command.
        """
        requested = np.stack(np.broadcast_arrays(np.asarray(v, dtype=float), np.asarray(omega, dtype=float)), axis=-1)
        (a11, a12, a13), _, (a31, a32, a33) = self.slip.rows
        command = requested.copy()
        for _ in range(30):
            vc, wc = np.moveaxis(command, -1, 0)
            off = self.twist(command)[..., [0, 2]] - requested
            slope = np.stack([1 + a11 + a13 * wc, a12 + a13 * vc, a31 + a33 * wc, 1 + a32 + a33 * vc], axis=-1)
            command = command - np.linalg.solve(slope.reshape(*vc.shape, 2, 2), off[..., None])[..., 0]
        if not np.allclose(self.twist(command)[..., [0, 2]], requested, atol=1e-6):
            raise ConfigError(f"turn costs '{self.name}': no command gives the body such a twist; ask a wider turn")
        return command

    def least_radius(self, speed: float | None = None) -> float:
        """Find the largest commanded radius with an outer torque above 95 % of its limit [m] at `speed` [m/s].

        By default at the speed of the table. 0: none does; infinity: every turn does.
        """
        checked_speed = self.curve.speed if speed is None else speed
        if not (np.isfinite(checked_speed) and checked_speed > 0):
            raise ConfigError(f"speed {checked_speed} m/s: give a positive number")

        def outer(radii: FloatArray) -> FloatArray:
            return self.torques(np.stack([np.full_like(radii, checked_speed), checked_speed / radii], axis=-1))[..., 1]

        return least_radius(outer, self.vehicle.torque_limit, _RADII, LIMIT_SHARE)

    def symbolic_power(self, v: Any, omega: Any) -> Any:  # noqa: ANN401 - SX or MX, as it is given
        """Build `power` as a CasADi expression of commands v [m/s], omega [rad/s], smooth everywhere."""
        vehicle, drive = self.vehicle, self.drive
        mean, difference = self._spline.symbolic(self._curvature(v, omega))
        half, total = 0.5 * (vehicle.command_track or vehicle.track), drive.idle_power
        for side in (-1.0, 1.0):
            rim = v + side * half * omega
            torque = _soft_sign(v) * mean + side * difference + vehicle.drag_torque * _soft_sign(rim)
            taken = torque * rim / vehicle.wheel_radius + drive.side_heating * torque**2
            if drive.regeneration and drive.driver_efficiency == 1.0:
                total = total + taken
                continue
            driving = 0.5 * (taken + ca.sqrt(taken**2 + _SOFT_POWER**2))
            returned = (taken - driving) * drive.driver_efficiency if drive.regeneration else 0.0
            total = total + driving / drive.driver_efficiency + returned
        return total

    def _curvature(self, v: Any, omega: Any) -> Any:  # noqa: ANN401 - arrays or expressions
        """Compute the signed curvature, as it counts at the speed of the table [1/m]."""
        exponent = self.curve.speed_exponent
        if exponent == 1.0:
            return omega / self.curve.speed
        return omega / ((v**2 + 1e-8) ** (0.5 * (1 - exponent)) * self.curve.speed**exponent)

    @cached_property
    def _spline(self) -> TorqueSpline:
        table, drag = self.curve, self.vehicle.drag_torque
        radii, outer, inner = (np.array(rows)[::-1] for rows in (table.radius, table.outer, table.inner))
        # Where the inner wheels of the table turn backward its inner torque holds their drag with the other sign.
        half = 0.5 * (self.vehicle.command_track or self.vehicle.track)
        inner_drag = np.where(radii < half, -drag, drag)
        outer, inner = outer - drag, inner - inner_drag
        return TorqueSpline(1.0 / radii, 0.5 * (outer + inner), 0.5 * (outer - inner))


def _soft_sign(speed: Any) -> Any:  # noqa: ANN401
    return ca.tanh(speed / _SOFT_SPEED)


def load_turn_costs(name: str | Path) -> TurnCosts:
    """Read turn costs by shipped name ("fsu_bot-default", ...) or path; raises ConfigError on a mistake in the file."""
    return load_checked(TurnCosts, named_file("turn costs", FLOORS, name))


def turn_costs_text(costs: TurnCosts) -> str:
    """Format the file that `load_turn_costs` reads, to five digits.

    Vehicle and drive stand in it by name where they are shipped ones, else whole.
    """
    plain: dict[str, Any] = costs.model_dump(mode="json")
    plain["vehicle"] = _name_or(costs.vehicle, VEHICLES, load_vehicle)
    plain["drive"] = _name_or(costs.drive, DRIVES, load_drive_constants)
    plain["slip"] = {key: float(f"{value:.5g}") for key, value in plain["slip"].items()}
    for key in ("radius", "outer", "inner"):
        plain["curve"][key] = [float(f"{value:.5g}") for value in plain["curve"][key]]
    return yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, width=140, default_flow_style=None)


def _name_or(value: StrictModel, folder: Path, load: Any) -> Any:  # noqa: ANN401
    names = [path.stem for path in sorted(folder.glob("*.yaml")) if load(path.stem) == value]
    return names[0] if names else value.model_dump(mode="json")
