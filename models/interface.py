"""Types and protocols shared by `mpc` and `sim`, so that neither of them imports the other.

Frames follow REP 103: x forward, y left, yaw counter-clockwise. Units are SI throughout.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, NoReturn, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc.models.errors import checked_methods, wrong_type

FloatArray = NDArray[np.float64]
AnyArray = NDArray[Any]
"""Array of real numbers, or of complex numbers for complex-step differentiation."""


def checked_array(argument: str, value: ArrayLike, expected: str, remedy: str) -> FloatArray:
    """Return `value` as an array of floats; raise ArgumentError if it does not consist of numbers."""
    try:
        if not np.iscomplexobj(value):
            return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        pass
    raise wrong_type(argument, expected, value, remedy)


@checked_methods
@dataclass(frozen=True, eq=False, slots=True)
class Stamped:
    """Measured value with the time of its measurement.

    Attributes
    ----------
    value
        The measured value; the field of `Measurement` defines its shape.
    time
        Time of measurement, not of arrival [s], on the clock of the controller.
    covariance
        (k, k) covariance of the value; None if it is unknown.
    """

    value: ArrayLike
    time: float
    covariance: ArrayLike | None = None


@checked_methods
@dataclass(frozen=True, slots=True)
class Measurement:
    """Measurements since the last control tick; None if there is no new measurement.

    Attributes
    ----------
    pose
        (3,) x [m], y [m], theta [rad] in the frame of the reference; theta may be wrapped.
    wheel_twist
        (2,) v [m/s] and omega [rad/s] from the encoders and the geometric track.
    yaw_rate
        () yaw rate of the gyro [rad/s]. On a skid-steered robot it differs from the wheels' yaw rate by the yaw gain.
    wheel_speeds
        (4,) front left, front right, rear left, rear right [rad/s]; for logs and identification.
    sent
        (v, omega) that the robot received in the last tick, if known; it may differ from the command.

    Raises
    ------
    ArgumentError
        If a value other than `sent` is not `Stamped`. `Controller.step` checks the content and does not raise errors
        for invalid data.
    """

    pose: Stamped | None = None
    wheel_twist: Stamped | None = None
    yaw_rate: Stamped | None = None
    wheel_speeds: Stamped | None = None
    sent: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Raise ArgumentError for values without a time."""
        for value in (self.pose, self.wheel_twist, self.yaw_rate, self.wheel_speeds):
            if value is not None and not isinstance(value, Stamped):
                self._refuse(value)

    def _refuse(self, value: object) -> NoReturn:
        name = next(name for name in self.__slots__ if getattr(self, name) is value)
        remedy = f"write {name}=Stamped(value, time in s)"
        raise wrong_type(f"Measurement({name}=...)", "a value with its time", value, remedy)


class ReferenceSample(NamedTuple):
    """Reference trajectory evaluated at n times."""

    pose: FloatArray
    """(n, 3) x [m], y [m], theta [rad]; theta is unwrapped."""
    twist: FloatArray
    """(n, 2) v [m/s], omega [rad/s]."""
    arc_length: FloatArray
    """(n,) distance travelled along the path since its start [m]."""


@runtime_checkable
class Reference(Protocol):
    """Timed trajectory; the reference is at rest at its start before time 0 and at its end after `duration`."""

    @property
    def name(self) -> str:
        """Name for tables and figures."""
        ...

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        ...

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Evaluate at `times` (n,) [s], counted from the start of the reference."""
        ...


class ControlStep(Protocol):
    """Result of a controller for one tick; the closed loop reads these fields.

    A controller with an estimator adds `estimate`, a `MotionEstimate`, or None before the first estimate.
    """

    @property
    def command(self) -> FloatArray:
        """(2,) v [m/s], omega [rad/s]; finite and within the limits."""
        ...

    @property
    def mode(self) -> str:
        """Name of the controller's mode; `TRACKING` in normal operation."""
        ...

    @property
    def message(self) -> str:
        """Reason for the mode, in one sentence; empty in normal operation."""
        ...

    @property
    def solver(self) -> Any:  # noqa: ANN401 - the type depends on the solver
        """Report with `status`, `method` and `iterations`; None for a controller without a solver."""
        ...

    @property
    def solve_time(self) -> float:
        """Part of `step_time` for the formulation and solution of the problem [s]; NaN if no problem was solved."""
        ...

    @property
    def plan(self) -> FloatArray | None:
        """(N + 1, 3) predicted poses; None for a controller without prediction."""
        ...

    @property
    def step_time(self) -> float:
        """Duration of the whole step [s]."""
        ...


class MotionEstimate(Protocol):
    """Estimate of the robot's motion at a tick, with standard deviations."""

    @property
    def pose(self) -> FloatArray:
        """(3,) x [m], y [m], theta [rad, unwrapped]."""
        ...

    @property
    def pose_deviation(self) -> FloatArray:
        """(3,) standard deviations of the pose [m, m, rad]."""
        ...

    @property
    def twist(self) -> FloatArray:
        """(2,) v [m/s], omega [rad/s] of the body."""
        ...

    @property
    def twist_deviation(self) -> FloatArray:
        """(2,) standard deviations of the twist [m/s, rad/s]."""
        ...


class TrackingController(Protocol):
    """Interface of controllers in the closed loop: the MPC and its peers."""

    def start(self, reference: Reference, t0: float) -> None:
        """Start to track `reference`, whose time 0 is `t0` [s] on the controller's clock."""
        ...

    def step(self, t: float, measurement: Measurement) -> ControlStep:
        """Compute the command for the tick at time `t` [s]."""
        ...


@dataclass(frozen=True)
class CompiledTick:
    """Tick of a controller in C, for a simulation that runs ticks without Python.

    Attributes
    ----------
    fields
        Addresses by field of `closed_loop` (sim/core/closed_loop.h): the function of the step with its controller and
        input, fields of the input, and numbers of the result. A tick is ordinary if the step returns 0 and `mode`,
        `reasons`, `notes` and `status` are 0; otherwise Python has to complete the tick. `method`, the code of the
        solver's method, and `iterations` are the addresses of two further integers of the result.
    start
        Time 0 of the reference [s].
    steps
        Result of an ordinary tick by code of the method; its arrays are views of the controller's memory.
    is_next
        Function that prepares the input and returns True if the next tick can be computed in C.
    record
        Function to be called after ordinary ticks with the time of the last one [s].
    complete
        Function that completes a tick that is not ordinary, given its time [s] and the return value of the step.
    """

    fields: Mapping[str, int]
    start: float
    steps: Mapping[int, ControlStep]
    is_next: Callable[[], bool]
    record: Callable[[float], None]
    complete: Callable[[float, int], ControlStep]


@runtime_checkable
class CompiledController(Protocol):
    """Controller whose ordinary ticks can be computed in C."""

    def compiled_tick(self) -> CompiledTick:
        """Return the tick for the current drive; it is valid until the next call of `start`."""
        ...


class ReadOnlyArrays:
    """Base class of frozen dataclasses, without slots, whose arrays are read-only views.

    The caller's arrays are not changed. Arrays are also read-only after unpickling.
    """

    def __post_init__(self) -> None:
        """Replace the arrays by read-only views."""
        self.__setstate__(vars(self).copy())

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Set the fields, with arrays replaced by read-only views."""
        for name, value in state.items():
            vars(self)[name] = _read_only(value) if isinstance(value, np.ndarray) else value

    def __repr__(self) -> str:
        """Return names and shapes of the arrays, without values."""
        shapes = [f"{name} {value.shape}" for name, value in vars(self).items() if isinstance(value, np.ndarray)]
        return f"{type(self).__name__}: {', '.join(shapes)}"


def _read_only(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    view = array.view()
    view.setflags(write=False)
    return view
