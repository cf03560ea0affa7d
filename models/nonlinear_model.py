"""Velocity models defined by functions, for robots whose response to a command depends on their motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NoReturn, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc.models.errors import checked_methods
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.velocity_model import CHANNELS, ModelError


@dataclass(frozen=True)
class CompiledStep:
    """C functions of the core for a model, so that a controller need not compile the CasADi functions.

    Attributes
    ----------
    step, output
        Names of the C functions.
    parameters
        (Q,) parameters of the functions.
    work
        Work memory of the step [reals].
    """

    step: str
    output: str
    parameters: FloatArray
    work: int


@checked_methods
@dataclass(frozen=True, eq=False, repr=False)
class NonlinearModel:
    """x[k+1] = step(x[k], window), y[k] = output(x[k]); window = (u[k - memory], ..., u[k]), oldest first.

    u = (v_ref [m/s], omega_ref [rad/s]), y = (v [m/s], omega [rad/s]). The window models dead time: a step that depends
    on older commands responds late. A model without states, such as a network on past commands, uses its last output as
    state; its step depends on the window only. x = 0 must be the steady state for u = 0.

    At every tick, the controller linearises the model along its plan, and the estimator along the sent commands.

    Attributes
    ----------
    name
        Name for tables and messages.
    step
        CasADi function of `x` (n) and `window` (2 (memory + 1)), in this order, that returns x (n) one sample later.
    output
        CasADi function of `x` (n) that returns y (2).
    dt
        Sample time of `step` [s]; must equal the configuration's `sample_time`.
    memory
        Number of past commands that still act on future states, at least 1.
    known_lag
        (2,) mean delay of each channel [s], if it is known more accurately than from samples; see `lag`.
    provenance
        Source of the parameters; empty for a user's functions.
    delay
        (2,) zeros, because the dead time is part of the window, unlike the dead time of a discretised linear model.

    Raises
    ------
    ModelError
        If names or shapes do not match, if x = 0 is not a steady state, or if the linearisation at rest is unstable or
        has a gain that is not positive.
    """

    name: str
    step: ca.Function
    output: ca.Function
    dt: float
    memory: int = 1
    known_lag: ArrayLike | None = None
    provenance: Mapping[str, object] = field(default_factory=dict)
    delay: NDArray[np.int64] = field(default_factory=lambda: np.zeros(2, dtype=np.int64), init=False, repr=False)

    def __repr__(self) -> str:
        """Format kind, name, order and sample time in one line."""
        return (
            f"{type(self).__name__} {self.name!r} (a function; order {self.order}, {self.memory} past commands, "
            f"samples of {self.dt:g} s)"
        )

    def __post_init__(self) -> None:
        """Check names, shapes, steady state and stability."""
        where = f"model '{self.name}'"
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise ModelError(f"{where}: dt = {self.dt} s; give the positive sample time that step is for")
        if self.memory < 1:
            raise ModelError(f"{where}: memory = {self.memory}; give 1 or more, the window holds a past command")
        self._check_function("step", self.step, {"x": self.order, "window": 2 * (self.memory + 1)}, self.order)
        self._check_function("output", self.output, {"x": self.order}, 2)
        if self.known_lag is not None and not (
            np.shape(self.known_lag) == (2,) and np.isfinite(np.asarray(self.known_lag, dtype=float)).all()
        ):
            raise ModelError(f"{where}: known_lag = {self.known_lag}; give a time in seconds for v and for omega")
        try:
            rest = np.concatenate([self.step(0, 0).full(), self.output(0).full()])
            A, B, C = self.linearised
        except RuntimeError as error:
            raise ModelError(
                f"{where}: CasADi cannot differentiate step and output; use SX, and call no solver or table"
            ) from error
        if not (np.isfinite(rest).all() and np.abs(rest).max() < 1e-9):
            raise ModelError(f"{where}: x = 0 must be the steady state for zero commands; shift the states")
        if not (np.isfinite(A).all() and np.isfinite(B).all() and np.isfinite(C).all()):
            raise ModelError(f"{where}: the derivatives at rest are not finite; make the functions smooth there")
        radius = np.abs(np.linalg.eigvals(A)).max()
        if not radius < 1:
            raise ModelError(f"{where}: unstable at rest, a state grows by {radius:.3g} each sample")
        for channel, gain in zip(CHANNELS, np.diag(self.dc_gain), strict=True):
            if not gain > 0:
                raise ModelError(f"{where}: gain {gain:.4g} from {channel}_ref to {channel} at rest; check the sign")

    def _check_function(self, role: str, function: object, inputs: dict[str, int], rows: int) -> None:
        where = f"model '{self.name}': {role}"
        if not isinstance(function, ca.Function):
            raise ModelError(f"{where} is a {type(function).__name__}; give a casadi.Function")
        if function.has_free():
            raise ModelError(
                f"{where} depends on {', '.join(map(str, function.get_free()))}; replace free symbols by numbers"
            )
        if function.name_in() != list(inputs):
            raise ModelError(f"{where} has the inputs {', '.join(function.name_in())}; name them {', '.join(inputs)}")
        for name, length in inputs.items():
            if function.size_in(name) != (length, 1):
                raise ModelError(f"{where} has {function.numel_in(name)} numbers in {name}, expected {length}")
        if function.n_out() != 1 or function.size_out(0) != (rows, 1):
            raise ModelError(f"{where} gives {function.numel_out(0)} numbers, expected one column of {rows}")

    @property
    def structure(self) -> str:
        """Name of the kind of model, for tables."""
        return "function"

    @property
    def compiled_step(self) -> CompiledStep | None:
        """Compiled step of the core; None for a user's functions. Raises ModelError for an unknown kind."""
        return None

    @property
    def details(self) -> tuple[tuple[str, str], ...]:
        """Labels and values of additional lines in `models show`."""
        return ()

    @property
    def plant_step(self) -> ca.Function:
        """Step function for a simulated plant: `step`, or the exact function if `step` is a smooth approximation."""
        return self.step

    @property
    def order(self) -> int:
        """Number of states n."""
        return int(self.output.size1_in(0))

    @cached_property
    def _jacobians(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A (n, n), B (n, memory + 1, 2) for each command of the window, and C (2, n), at rest."""
        x, window = ca.SX.sym("x", self.order), ca.SX.sym("window", 2 * (self.memory + 1))
        after, y = self.step(x, window), self.output(x)
        jacobians = [ca.jacobian(after, x), ca.jacobian(after, window), ca.jacobian(y, x)]
        A, B, C = (part.full() for part in ca.Function("jacobians", [x, window], jacobians)(0, 0))
        return A, B.reshape(self.order, self.memory + 1, 2), C

    @property
    def linearised(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A (n, n), B (n, 2) summed over the window, and C (2, n), at rest."""
        A, B, C = self._jacobians
        return A, B.sum(axis=1), C

    @property
    def dead_samples(self) -> NDArray[np.int64]:
        """(2,) age of the newest command that acts on the states, at rest."""
        # The window has the oldest command first.
        acts = np.abs(self._jacobians[1]).max(axis=0)[::-1] > 0
        return np.asarray(acts.argmax(axis=0))

    @property
    def drive(self) -> FloatArray:
        """(n, 2) effect on the states, in one sample at rest, of a command held over the whole window."""
        return self.linearised[1]

    @property
    def settled(self) -> FloatArray:
        """(n, 2) steady state per unit of a small constant command."""
        A, B, _ = self.linearised
        return np.asarray(np.linalg.solve(np.eye(self.order) - A, B))

    @property
    def dc_gain(self) -> FloatArray:
        """(2, 2) steady-state gain at rest."""
        return np.asarray(self.linearised[2] @ self.settled)

    @property
    def lag(self) -> FloatArray:
        """(2,) mean delay of each channel [s] for small commands: `known_lag`, or else the lag of the samples.

        The lag of the samples is the area between a step and the linearly interpolated step response: dt (m - 1/2),
        where m is the mean of the impulse response in samples. It is exact for the controller, which predicts arcs with
        the mean of v at both ends. The lag of a continuous model differs by about dt^2 over its time constant.
        """
        if self.known_lag is not None:
            return np.array(self.known_lag, dtype=float)
        A, B, C = self._jacobians
        # The mean of the impulse response is the sum of the mean age in the window and the delay of the states.
        ages = np.arange(self.memory, -1, -1.0)
        weighted = np.einsum("nwj,w->nj", B, ages)
        moment = C @ np.linalg.solve(np.eye(self.order) - A, self.settled + weighted)
        return np.asarray(self.dt * (np.diag(moment) / np.diag(self.dc_gain) - 0.5))

    def with_extra_dead_time(self, extra: ArrayLike) -> Self:
        """Return the model itself if `extra` is zero; otherwise raise ModelError, as the window cannot be extended."""
        if np.any(np.asarray(extra, dtype=float)):
            raise ModelError(
                f"model '{self.name}': extra dead time {np.asarray(extra).tolist()} s: the dead time is part of "
                "the window; train or define the model with it, or set extra_dead_time to 0"
            )
        return self

    def discretise(self, dt: float) -> NoReturn:
        """Raise ModelError: the model is defined at one sample time only; `linearised` approximates it near rest.

        Raises
        ------
        ModelError
            Always.
        """
        raise ModelError(
            f"model '{self.name}': a nonlinear model with sample time {self.dt} s cannot be sampled at {dt} s; "
            "use step, or a linear model"
        )

    def to_control(self, dt: float | None = None) -> NoReturn:
        """Raise ModelError: python-control has no system of a nonlinear model; `linearised` approximates it near rest.

        Raises
        ------
        ModelError
            Always.
        """
        del dt
        raise ModelError(f"model '{self.name}' is nonlinear and has no transfer function; use its `linearised`")

    def simulate(
        self, commands: ArrayLike, state: ArrayLike | None = None, past: ArrayLike | None = None
    ) -> FloatArray:
        """Simulate the response to commands.

        Parameters
        ----------
        commands
            (K, 2) v_ref [m/s], omega_ref [rad/s].
        state
            (n,) state at sample 0; zero (at rest) by default.
        past
            (memory, 2) commands before sample 0, oldest first; zero by default.

        Returns
        -------
        FloatArray
            (K, 2) v [m/s] and omega [rad/s] at samples 0 to K - 1.
        """
        commands = np.asarray(commands, dtype=float)
        before = np.zeros((self.memory, 2)) if past is None else np.asarray(past, dtype=float)
        x = np.zeros(self.order) if state is None else np.array(state, dtype=float)
        history, outputs = np.vstack([before, commands]), np.empty((len(commands), 2))
        for k in range(len(commands)):
            outputs[k] = self.output(x).full().ravel()
            x = self.step(x, history[k : k + self.memory + 1].ravel()).full().ravel()
        return outputs
