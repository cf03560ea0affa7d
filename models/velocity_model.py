"""Common interface of MBM, SM and SSM: a continuous linear system with a dead time for each input."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.discrete_model import DiscreteModel, zero_order_hold
from diffdrive_mpc.models.errors import DiffdriveMpcError, checked_methods, checked_number, wrong_type
from diffdrive_mpc.models.interface import FloatArray, checked_array

CHANNELS = ("v", "omega")

# Gains of a model from twist to twist are of order one; gains outside this range indicate a wrong unit (deg, rpm, mm).
_GAIN_RANGE = (0.05, 20.0)
# Plausible time constants of a robot's velocity dynamics [s].
_TIME_CONSTANT_RANGE = (1e-3, 20.0)
_MAX_DEAD_TIME = 2.0
_REMEDY = 'write VelocityModel("mine", "ssm", A, B, C, dead_time) with arrays (n, n), (n, 2), (2, n), (2,)'


class ModelError(DiffdriveMpcError, ValueError):
    """Error for a velocity model that cannot be used: one line with model, mistake and remedy."""


def mean_delay(A: FloatArray, B: FloatArray, C: FloatArray, dead_time: FloatArray, inputs: Sequence[int]) -> FloatArray:
    """Compute the mean delay (p,) of the response of each output to one of the inputs [s]: dead time plus lag.

    The system is x' = A x + B u(t - dead_time), y = C x with n states, m inputs and p outputs; `inputs` (p,) are the
    indices of the inputs.
    """
    # The lag of a transfer function is -G'(0) / G(0), with G(0) = -C A^-1 B and G'(0) = -C A^-2 B.
    settled, pairs = np.linalg.solve(A, B), (np.arange(len(C)), list(inputs))
    return np.asarray(np.asarray(dead_time)[pairs[1]] - (C @ np.linalg.solve(A, settled))[pairs] / (C @ settled)[pairs])


@checked_methods
@dataclass(frozen=True, eq=False, repr=False)
class VelocityModel:
    """Linear dynamics from commanded to true body twist, x' = A x + B u(t - dead_time), y = C x.

    u = (v_ref [m/s], omega_ref [rad/s]), y = (v [m/s], omega [rad/s]).

    Attributes
    ----------
    name
        Name for tables and messages.
    structure
        Label of its structure, such as "mbm", "sm" or "ssm".
    A, B, C
        (n, n), (n, 2), (2, n).
    dead_time
        (2,) dead time of each input [s].
    provenance
        Source of the parameters, as stated by the parameter file.

    Raises
    ------
    ModelError
        If a matrix has the wrong shape or is not finite, if the model is unstable, or if gains, time constants or dead
        times are implausible for a robot in SI units.
    """

    name: str
    structure: str
    A: FloatArray
    B: FloatArray
    C: FloatArray
    dead_time: FloatArray = field(default_factory=lambda: np.zeros(2))
    provenance: Mapping[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Convert the fields to arrays and check them."""
        for name in ("name", "structure"):
            if not isinstance(getattr(self, name), str):
                raise wrong_type(name, "a text", getattr(self, name), _REMEDY)
        for name in ("A", "B", "C", "dead_time"):
            value = checked_array(name, getattr(self, name), "real numbers", _REMEDY)
            object.__setattr__(self, name, value.copy())
        self._check()

    @staticmethod
    def from_control(system: Any, dead_time: ArrayLike = (0.0, 0.0), name: str | None = None) -> VelocityModel:  # noqa: ANN401
        """Create a model from systems of python-control.

        Parameters
        ----------
        system
            A `control.TransferFunction` or `control.StateSpace` from (v_ref, omega_ref) to (v, omega), or a pair of
            single-input systems for v and omega. A discrete system is converted to a continuous system by the exact
            inverse of a zero-order hold; delays of whole samples become dead time.
        dead_time
            (2,) additional dead time of each input [s]; systems of python-control have no dead time.
        name
            Name for tables and messages; by default the name of the system.

        Raises
        ------
        ArgumentError, ModelError
            If `system` has another type or another number of inputs or outputs, has a direct feedthrough, or cannot
            describe a robot; or if no continuous system corresponds to a discrete one.
        """
        from diffdrive_mpc.models.control_systems import from_control  # noqa: PLC0415 - needs this module, and SciPy

        return from_control(system, dead_time, name)

    def to_control(self, dt: float | None = None) -> Any:  # noqa: ANN401 - python-control has no types
        """Create a `control.StateSpace` from (v_ref, omega_ref) to (v, omega).

        Parameters
        ----------
        dt
            Sample time [s] of the exact discrete system for a zero-order hold, in which pending commands of the dead
            time are additional states. None for the continuous system x' = A x + B u, y = C x without `dead_time`,
            which python-control does not support.
        """
        from diffdrive_mpc.models.control_systems import to_control  # noqa: PLC0415 - needs this module, and SciPy

        return to_control(self, dt)

    def __repr__(self) -> str:
        """Format name, structure, order, and gain, lag and dead time of each channel in one line."""
        channels = [
            f"{channel}: gain {gain:.3g}, lag {1e3 * lag:.0f} ms of which {1e3 * dead_time:.0f} ms dead time"
            for channel, gain, lag, dead_time in zip(
                CHANNELS, np.diag(self.dc_gain), self.lag, self.dead_time, strict=True
            )
        ]
        return f"VelocityModel {self.name!r} ({self.structure}, order {self.order}; {'; '.join(channels)})"

    @property
    def order(self) -> int:
        """Number of states n."""
        return int(self.A.shape[0])

    @property
    def poles(self) -> FloatArray:
        """(n,) eigenvalues of A [rad/s], complex."""
        return np.asarray(np.linalg.eigvals(self.A))

    @property
    def dc_gain(self) -> FloatArray:
        """(2, 2) steady-state gain from command to twist."""
        return np.asarray(-self.C @ np.linalg.solve(self.A, self.B))

    @property
    def lag(self) -> FloatArray:
        """(2,) mean delay of each channel [s]: dead time plus the lag of the dynamics at zero frequency."""
        return mean_delay(self.A, self.B, self.C, self.dead_time, (0, 1))

    def with_extra_dead_time(self, extra: ArrayLike) -> VelocityModel:
        """Return the model with its dead time increased by `extra` [s], (2,) or one number for both, at least 0."""
        added = checked_array("extra dead time", extra, "numbers", "give v, omega in seconds, such as (0.02, 0.02)")
        if (added < 0).any():
            raise ModelError(f"model '{self.name}': extra dead time {added.tolist()} s; give 0 or more")
        return replace(self, dead_time=self.dead_time + added)

    def discretise(self, dt: float) -> DiscreteModel:
        """Discretise exactly with a zero-order hold, dead time included.

        Parameters
        ----------
        dt
            Sample time [s]; the dead times need not be multiples of it.

        Raises
        ------
        ModelError
            If `dt` is not positive and finite.
        ArgumentError
            If `dt` is not a number.
        """
        dt = checked_number("sample time dt", dt, "give seconds, such as 0.02")
        if not (np.isfinite(dt) and dt > 0):
            raise ModelError(f"model '{self.name}': sample time {dt} s; it must be positive and finite")
        return zero_order_hold(self.A, self.B, self.C, self.dead_time, dt)

    def _check(self) -> None:
        where = f"model '{self.name}'"
        n = len(np.atleast_1d(self.A))
        shapes = {"A": (n, n), "B": (n, 2), "C": (2, n), "dead_time": (2,)}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise ModelError(f"{where}: {name} has shape {value.shape}, expected {shape}: A has {n} rows")
            if not np.isfinite(value).all():
                raise ModelError(f"{where}: {name} holds a value that is not finite; identify the model again")
        rightmost = self.poles[np.argmax(self.poles.real)]
        if rightmost.real >= 0:
            raise ModelError(
                f"{where}: unstable, pole at {rightmost:.4g} rad/s; every pole must lie left of the imaginary axis"
            )
        constants = 1 / np.abs(self.poles)
        if constants.min() < _TIME_CONSTANT_RANGE[0] or constants.max() > _TIME_CONSTANT_RANGE[1]:
            raise ModelError(
                f"{where}: time constants {constants.min():.3g} to {constants.max():.3g} s; expected within "
                f"{_TIME_CONSTANT_RANGE[0]} to {_TIME_CONSTANT_RANGE[1]} s: are the poles in rad/s?"
            )
        for channel, gain in zip(CHANNELS, np.diag(self.dc_gain), strict=True):
            if not _GAIN_RANGE[0] <= gain <= _GAIN_RANGE[1]:
                raise ModelError(
                    f"{where}: steady-state gain {gain:.4g} from {channel}_ref to {channel}; expected "
                    f"{_GAIN_RANGE[0]} to {_GAIN_RANGE[1]}: check the sign and the units (m/s, rad/s)"
                )
        if (self.dead_time < 0).any() or (self.dead_time > _MAX_DEAD_TIME).any():
            raise ModelError(f"{where}: dead time {self.dead_time.tolist()} s; expected 0 to {_MAX_DEAD_TIME} s")
