"""Turn costs of a robot on a surface: torques, power and least radius of turns, for planner, controller and studies.

The torques of both sides are one smooth function of the signed curvature, for NumPy arrays and CasADi expressions. The
right side is the outer side in left turns and the inner side in right turns. All torques change their sign for backward
driving. Let m be the mean and d half the difference of the outer and inner torques, both without the drag of the drive
train. The torque is then sign(v) m(k) + d(k) on the right and sign(v) m(k) - d(k) on the left, where m is even and d is
odd in the curvature k. The power is therefore smooth and even about k = 0. The drag changes its sign with the direction
of wheel rotation, which for the inner wheels is backward in sharp turns.
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

_RADII_PER_DECADE = 60


def least_radius(
    outer_torque: Callable[[FloatArray], ArrayLike],
    limit: float,
    radii: tuple[float, float] = (0.05, 1000.0),
    share: float = LIMIT_SHARE,
) -> float:
    """Find the largest radius at which the outer torque exceeds a share of its limit [m].

    Parameters
    ----------
    outer_torque
        Function that returns the torque of the outer side [N m] at radii (n,) [m].
    limit
        Torque limit of a side [N m].
    radii
        Minimum and maximum radius of the search [m].
    share
        Share of the limit [-].

    Returns
    -------
    float
        The radius; 0 if no torque exceeds the share, infinity if the torque at the maximum radius does.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the limit is not a positive number, or a torque is not finite.
    """
    if not (math.isfinite(limit) and limit > 0):
        raise ConfigError(f"torque limit {limit} N m: use a positive number")
    low, high = np.log10(radii)
    grid = np.logspace(low, high, max(2, round((high - low) * _RADII_PER_DECADE)))
    torque = np.abs(np.asarray(outer_torque(grid), dtype=float))
    if not np.isfinite(torque).all():
        raise ConfigError("the torque is not finite at some radius; the least radius cannot be determined")
    exceeding = np.flatnonzero(torque > share * limit)
    if not exceeding.size:
        return 0.0
    last = int(exceeding[-1])
    if last == len(grid) - 1:
        return math.inf
    low_radius, high_radius = grid[last], grid[last + 1]
    for _ in range(40):
        middle = math.sqrt(low_radius * high_radius)
        exceeds = abs(float(np.asarray(outer_torque(np.array([middle])))[0])) > share * limit
        low_radius, high_radius = (middle, high_radius) if exceeds else (low_radius, middle)
    return float(math.sqrt(low_radius * high_radius))


_DEGREE = 3
_INTERVALS = 36
_POINTS_PER_INTERVAL = 60
_CURVATURE_SCALE = 0.05
"""Curvature at which the scale changes from linear to logarithmic [1/m]."""


class TorqueSpline:
    """Cubic splines through a table over asinh of the curvature; beyond the table the values at its ends apply.

    Parameters
    ----------
    curvature
        (n,) ascending positive curvatures [1/m].
    mean
        (n,) half the sum of outer and inner traction torque [N m].
    difference
        (n,) half the difference of outer and inner traction torque [N m].
    """

    def __init__(self, curvature: ArrayLike, mean: ArrayLike, difference: ArrayLike) -> None:
        scaled = np.arcsinh(np.asarray(curvature, dtype=float) / _CURVATURE_SCALE)
        self._limit = float(scaled[-1])
        self._width = 2 * self._limit / _INTERVALS
        self._knots = self._limit * np.linspace(-1, 1, _INTERVALS + 1)
        outer_knots = self._width * np.arange(1, _DEGREE + 1)
        knots = np.concatenate([-self._limit - outer_knots[::-1], self._knots, self._limit + outer_knots])
        dense = np.linspace(-self._limit, self._limit, _POINTS_PER_INTERVAL * _INTERVALS + 1)
        self._splines = []
        for values, is_odd in ((mean, False), (difference, True)):
            torques = np.asarray(values, dtype=float)
            # At zero curvature the difference is zero, and the mean equals that of the widest turn.
            table = PchipInterpolator(np.append(0.0, scaled), np.append(0.0 if is_odd else torques[0], torques))
            dense_values = table(np.abs(dense)) * (np.sign(dense) if is_odd else 1.0)
            self._splines.append(make_lsq_spline(dense, dense_values, knots, k=_DEGREE))

    def __call__(self, curvature: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute mean and half difference [N m] at signed curvatures (n,) [1/m]."""
        scaled = np.clip(np.arcsinh(curvature / _CURVATURE_SCALE), -self._limit, self._limit)
        mean, difference = (np.asarray(spline(scaled)) for spline in self._splines)
        return mean, difference

    def symbolic(self, curvature: Any) -> tuple[Any, Any]:  # noqa: ANN401 - SX or MX
        """Build mean and half difference as CasADi expressions, twice differentiable except at the table ends."""
        scaled = ca.fmax(-self._limit, ca.fmin(self._limit, ca.asinh(curvature / _CURVATURE_SCALE)))
        # Uniform B-splines as truncated cubes: without case distinctions, derivatives are valid everywhere.
        binomial = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6.0
        weights = [np.convolve(spline.c, binomial) for spline in self._splines]
        mean: Any = 0.0
        difference: Any = 0.0
        for k, knot in enumerate(self._splines[0].t):
            if knot < self._limit:
                distance = ca.fmax(0.0, (scaled - knot) / self._width)
                cube = distance * distance * distance
                mean, difference = mean + weights[0][k] * cube, difference + weights[1][k] * cube
        return mean, difference


FLOORS = Path(__file__).parent / "floors"
# Widths of the smooth transitions of signs of speeds [m/s] and powers [W] in symbolic expressions.
_SOFT_SPEED, _SOFT_POWER = 0.01, 0.05
_RADII = (0.05, 1000.0)


def _load_if_name(value: Any) -> Any:  # noqa: ANN401 - content of a file
    return load_vehicle(value) if isinstance(value, str) else value


class SlipCoefficients(StrictModel):
    """Coefficients of `models.slip_laws.polynomial_twist`: changes of the commanded twist; lateral is to the left."""

    a11: float = Field(default=0.0, description="change of the forward speed over v_c [-]")
    a12: float = Field(default=0.0, description="change of the forward speed over w_c [m]")
    a13: float = Field(default=0.0, description="change of the forward speed over v_c w_c [s]")
    a21: float = Field(default=0.0, description="lateral speed over v_c [-]")
    a22: float = Field(default=0.0, description="lateral speed over w_c [m]")
    a23: float = Field(default=0.0, description="lateral speed over v_c w_c [s]")
    a31: float = Field(default=0.0, description="change of the yaw rate over v_c [1/m]")
    a32: float = Field(default=0.0, description="change of the yaw rate over w_c [-]")
    a33: float = Field(default=0.0, description="change of the yaw rate over v_c w_c [s/m]")

    @property
    def rows(self) -> FloatArray:
        """Coefficients (3, 3), rows for forward speed, lateral speed and yaw rate."""
        return np.array([getattr(self, name) for name in POLYNOMIAL]).reshape(3, 3)

    @classmethod
    def from_rows(cls, rows: ArrayLike) -> Self:
        """Build from nine numbers, row by row; raises ConfigError for another shape or numbers that are not finite."""
        values = np.asarray(rows, dtype=float).ravel()
        if values.shape != (9,) or not np.isfinite(values).all():
            raise ConfigError(f"slip of shape {np.shape(rows)}: use nine finite numbers, a11 to a33 row by row")
        return cls.model_validate(dict(zip(POLYNOMIAL, values.tolist(), strict=True)))


class TorqueTable(StrictModel):
    """Torques of steady turns; beyond the table the values at its ends apply."""

    radius: Annotated[tuple[Positive, ...], Field(min_length=3)] = Field(description="commanded radii, ascending [m]")
    outer: Annotated[tuple[float, ...], Field(min_length=3)] = Field(description="torque of the outer side [N m]")
    inner: Annotated[tuple[float, ...], Field(min_length=3)] = Field(description="torque of the inner side [N m]")
    speed: Positive = Field(description="speed of the turns in the table [m/s]")
    speed_exponent: float = Field(
        ge=0.0, le=1.0, description="exponent e of the equivalent radius R (speed / v)^e of a turn at speed v [-]"
    )

    @model_validator(mode="after")
    def _check_rows(self) -> Self:
        if not len(self.radius) == len(self.outer) == len(self.inner):
            raise ValueError(
                f"{len(self.radius)} radii, {len(self.outer)} outer and {len(self.inner)} inner torques: use equal "
                "numbers of them"
            )
        if not (np.diff(self.radius) > 0).all():
            raise ValueError("radius: the values must ascend")
        return self


class TurnCosts(StrictModel):
    """Turn costs of a robot on a surface.

    Beyond the table the values at its ends apply. Turns sharper than the sharpest turn of the table have its cost:
    there the motors are at their limit or the tyres slide.
    """

    name: str = Field(min_length=1)
    vehicle: Annotated[Vehicle, BeforeValidator(_load_if_name, json_schema_input_type=Vehicle | str)] = Field(
        description="vehicle as a mapping, or the name of a vehicle file"
    )
    drive: NamedDrive = Field(description="drive constants as a mapping, or the name of a drive file")
    slip: SlipCoefficients = Field(default_factory=SlipCoefficients, description="slip law; by default no slip")
    curve: TorqueTable
    provenance: str = Field(min_length=1, description="source of the values")

    def with_idle_power(self, power: float) -> Self:
        """Return a copy with another power of computer, sensors and drivers at rest [W].

        Raises ConfigError if the power is negative or not finite.
        """
        if not (np.isfinite(power) and power >= 0):
            raise ConfigError(f"idle power {power} W: use zero or a positive number")
        drive = self.drive.model_copy(update={"idle_power": float(power)})
        return self.model_copy(update={"drive": drive})

    def torques(self, commands: ArrayLike) -> FloatArray:
        """Compute torques (n, 2) left, right [N m] in steady turns for commands (n, 2) v [m/s], omega [rad/s].

        The torques are clipped at the torque limit.
        """
        rows = np.asarray(commands, dtype=float)
        v, omega = np.moveaxis(rows, -1, 0)
        mean, difference = self._spline(self._curvature(v, omega))
        traction = (np.sign(v) * mean)[..., None] + difference[..., None] * np.array([-1.0, 1.0])
        drag = self.vehicle.drag_torque * np.sign(self.vehicle.rim_speeds(rows))
        limit = self.vehicle.torque_limit
        return np.asarray(np.clip(traction + drag, -limit, limit))

    def power(self, commands: ArrayLike) -> FloatArray:
        """Compute the battery power (n,) [W] for commands (n, 2) v [m/s], omega [rad/s], including idle power."""
        rows = np.asarray(commands, dtype=float)
        return self.drive.robot_power(self.torques(rows), self.vehicle.rim_speeds(rows) / self.vehicle.wheel_radius)

    def twist(self, commands: ArrayLike) -> FloatArray:
        """Compute the body twist (n, 3) by the slip law: forward speed, lateral speed [m/s], yaw rate [rad/s]."""
        return polynomial_twist(self.slip.rows, commands)

    def command(self, v: ArrayLike, omega: ArrayLike) -> FloatArray:
        """Compute commands (..., 2) for body twists with forward speed `v` [m/s] and yaw rate `omega` [rad/s].

        Raises ConfigError if no command gives this twist by the slip law.
        """
        requested = np.stack(np.broadcast_arrays(np.asarray(v, dtype=float), np.asarray(omega, dtype=float)), axis=-1)
        (a11, a12, a13), _, (a31, a32, a33) = self.slip.rows
        command = requested.copy()
        for _ in range(30):
            vc, wc = np.moveaxis(command, -1, 0)
            error = self.twist(command)[..., [0, 2]] - requested
            jacobian = np.stack([1 + a11 + a13 * wc, a12 + a13 * vc, a31 + a33 * wc, 1 + a32 + a33 * vc], axis=-1)
            command = command - np.linalg.solve(jacobian.reshape(*vc.shape, 2, 2), error[..., None])[..., 0]
        if not np.allclose(self.twist(command)[..., [0, 2]], requested, atol=1e-6):
            raise ConfigError(f"turn costs '{self.name}': no command gives the body this twist; use a wider turn")
        return command

    def least_radius(self, speed: float | None = None) -> float:
        """Find the largest commanded radius with an outer torque above 95 % of its limit [m] at `speed` [m/s].

        The default speed is that of the table. Returns 0 if no turn exceeds the share, infinity if every turn does.
        """
        turn_speed = self.curve.speed if speed is None else speed
        if not (np.isfinite(turn_speed) and turn_speed > 0):
            raise ConfigError(f"speed {turn_speed} m/s: use a positive number")

        def outer_torque(radii: FloatArray) -> FloatArray:
            return self.torques(np.stack([np.full_like(radii, turn_speed), turn_speed / radii], axis=-1))[..., 1]

        return least_radius(outer_torque, self.vehicle.torque_limit, _RADII, LIMIT_SHARE)

    def symbolic_power(self, v: Any, omega: Any) -> Any:  # noqa: ANN401 - SX or MX
        """Build `power` as a smooth CasADi expression of commands v [m/s], omega [rad/s]."""
        vehicle, drive = self.vehicle, self.drive
        mean, difference = self._spline.symbolic(self._curvature(v, omega))
        half_track, total = 0.5 * (vehicle.command_track or vehicle.track), drive.idle_power
        for side in (-1.0, 1.0):
            rim_speed = v + side * half_track * omega
            torque = _soft_sign(v) * mean + side * difference + vehicle.drag_torque * _soft_sign(rim_speed)
            side_power = torque * rim_speed / vehicle.wheel_radius + drive.side_heating * torque**2
            if drive.regeneration and drive.driver_efficiency == 1.0:
                total = total + side_power
                continue
            driving = 0.5 * (side_power + ca.sqrt(side_power**2 + _SOFT_POWER**2))
            returned = (side_power - driving) * drive.driver_efficiency if drive.regeneration else 0.0
            total = total + driving / drive.driver_efficiency + returned
        return total

    def _curvature(self, v: Any, omega: Any) -> Any:  # noqa: ANN401 - arrays or expressions
        """Compute the signed curvature of the equivalent turn at the speed of the table [1/m]."""
        exponent = self.curve.speed_exponent
        if exponent == 1.0:
            return omega / self.curve.speed
        return omega / ((v**2 + 1e-8) ** (0.5 * (1 - exponent)) * self.curve.speed**exponent)

    @cached_property
    def _spline(self) -> TorqueSpline:
        table, drag = self.curve, self.vehicle.drag_torque
        radii, outer, inner = (np.array(rows)[::-1] for rows in (table.radius, table.outer, table.inner))
        # The drag of the inner wheels is negative in turns in which they turn backward.
        half_track = 0.5 * (self.vehicle.command_track or self.vehicle.track)
        inner_drag = np.where(radii < half_track, -drag, drag)
        outer, inner = outer - drag, inner - inner_drag
        return TorqueSpline(1.0 / radii, 0.5 * (outer + inner), 0.5 * (outer - inner))


def _soft_sign(speed: Any) -> Any:  # noqa: ANN401
    return ca.tanh(speed / _SOFT_SPEED)


def load_turn_costs(name: str | Path) -> TurnCosts:
    """Read turn costs by shipped name ("fsu_bot-default", ...) or path; raises ConfigError if the file is invalid."""
    return load_checked(TurnCosts, named_file("turn costs", FLOORS, name))


def turn_costs_text(costs: TurnCosts) -> str:
    """Format turn costs as a file for `load_turn_costs`, with five digits.

    Shipped vehicles and drives are written by name, others as mappings.
    """
    content: dict[str, Any] = costs.model_dump(mode="json")
    content["vehicle"] = _name_or_content(costs.vehicle, VEHICLES, load_vehicle)
    content["drive"] = _name_or_content(costs.drive, DRIVES, load_drive_constants)
    content["slip"] = {key: float(f"{value:.5g}") for key, value in content["slip"].items()}
    for key in ("radius", "outer", "inner"):
        content["curve"][key] = [float(f"{value:.5g}") for value in content["curve"][key]]
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=140, default_flow_style=None)


def _name_or_content(value: StrictModel, folder: Path, load: Any) -> Any:  # noqa: ANN401
    names = [path.stem for path in sorted(folder.glob("*.yaml")) if load(path.stem) == value]
    return names[0] if names else value.model_dump(mode="json")
