"""Results of a closed-loop run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc.models.errors import checked_call, load_pandas
from diffdrive_mpc.models.interface import FloatArray, Measurement, ReadOnlyArrays, Reference, ReferenceSample, Stamped
from diffdrive_mpc.models.logs.drive_log.tick import INPUT_NAMES, measured_cells
from diffdrive_mpc.models.step_scalars import step_scalars
from diffdrive_mpc.sim.metrics.metrics import TIME_TOLERANCE, Metrics, compute_metrics
from diffdrive_mpc.sim.metrics.recovery import Recovery, compute_recovery
from diffdrive_mpc.sim.metrics.tracking_errors import TrackingErrors, metric_settings, tracking_errors
from diffdrive_mpc.sim.plants.plug_ins import columns_of

if TYPE_CHECKING:
    from typing import Self

    from matplotlib.figure import Figure
    from pandas import DataFrame

NO_SOLVER = "none"
"""Solver method of a tick without a solve, or of a controller without a solver."""


@dataclass(frozen=True, repr=False)
class Run(ReadOnlyArrays):
    """Record of a closed-loop run of n ticks.

    Row k contains the values at tick k, before the command of the tick is effective. `print(run)` shows the statistics.

    Attributes
    ----------
    reference
        Tracked trajectory.
    sample_time
        Time between two ticks [s].
    time
        (n,) times of the ticks [s].
    true_pose
        (n, 3) x [m], y [m], theta [rad].
    true_twist
        (n, 3) forward speed [m/s], lateral speed [m/s], yaw rate [rad/s] in the body frame.
    reference_pose, reference_twist, reference_arc_length
        (n, 3) pose, (n, 2) twist and (n,) arc length [m] of the reference.
    command
        (n, 2) sent command v [m/s], omega [rad/s].
    step_time
        (n,) computation time of the controller's step [s].
    modes, messages
        Mode of the controller at each tick, and the reason for it.
    states
        Modes, with `LATE` instead of `TRACKING` while the robot lags behind its reference.
    measurements
        Measurements of the controller at each tick, from which the run can be replayed without the plant.
    disturbance
        Start of the first disturbance, and end of the last disturbance that ends during the run [s]; the end is
        infinite if no disturbance ends. None if there is no disturbance.
    ended
        Reason for an early end of the run in one line; empty if the run did not end early.
    solver_statuses
        Status of the controller's solver at each tick; empty strings for a controller without a solver.
    solver_methods
        Method of the solver at each tick: "none", "unlimited", "active_set", "osqp" or "daqp".
    solve_time, solver_iterations
        (n,) time for formulating and solving the problem [s], and iterations of the solver; NaN if no problem was
        solved.
    estimates
        (n, 5) estimate x [m], y [m], theta [rad], v [m/s], omega [rad/s] on which the command is based; NaN if the
        controller does not report an estimate.
    estimate_deviations
        (n, 5) standard deviations of the estimates.
    plans
        (n, N + 1, 3) predicted poses x [m], y [m], theta [rad] at each tick, one per sample, starting at the tick. In
        mode REUSED_PLAN, the poses are those of the last valid plan, which started earlier. NaN at ticks without a
        plan; N + 1 = 0 for a controller without prediction. Empty unless `keep_plans=True` is passed to `simulate`.
    motor_torque, motor_speed, motor_power, motor_square
        (n, 4) true means of each motor until the next tick: torque at the wheel [N m], wheel speed [rad/s], mechanical
        power [W], and square of the torque [N^2 m^2]. The order is front left, front right, rear left, rear right. NaN
        for a plant without motors.
    scalars
        (n, S) scalars that the controller reports, in the order of `models.step_scalars`; NaN for missing scalars.
    parts
        Records of simulator parts and plants of other packages, by registered name.
    """

    reference: Reference
    sample_time: float
    time: FloatArray
    true_pose: FloatArray
    true_twist: FloatArray
    reference_pose: FloatArray
    reference_twist: FloatArray
    reference_arc_length: FloatArray
    command: FloatArray
    step_time: FloatArray
    modes: tuple[str, ...]
    messages: tuple[str, ...]
    measurements: tuple[Measurement, ...]
    disturbance: tuple[float, float] | None = None
    ended: str = ""
    states: tuple[str, ...] = ()
    solver_statuses: tuple[str, ...] = ()
    solver_methods: tuple[str, ...] = ()
    solve_time: FloatArray = field(default_factory=lambda: np.empty(0))
    solver_iterations: FloatArray = field(default_factory=lambda: np.empty(0))
    estimates: FloatArray = field(default_factory=lambda: np.empty((0, 5)))
    estimate_deviations: FloatArray = field(default_factory=lambda: np.empty((0, 5)))
    plans: FloatArray = field(default_factory=lambda: np.empty((0, 0, 3)))
    motor_torque: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    motor_speed: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    motor_power: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    motor_square: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    scalars: FloatArray = field(default_factory=lambda: np.empty((0, len(step_scalars()))))
    parts: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Fill missing fields of states, solver, estimate, motors and scalars with default values."""
        count = len(self.time)
        defaults = {
            "states": self.modes,
            "solver_statuses": ("",) * count,
            "solver_methods": (NO_SOLVER,) * count,
            "solve_time": np.full(count, np.nan),
            "solver_iterations": np.full(count, np.nan),
            "estimates": np.full((count, 5), np.nan),
            "estimate_deviations": np.full((count, 5), np.nan),
            "scalars": np.full((count, len(step_scalars())), np.nan),
            **{f"motor_{quantity}": np.full((count, 4), np.nan) for quantity in ("torque", "speed", "power", "square")},
        }
        vars(self).update({name: rows for name, rows in defaults.items() if not len(vars(self)[name])})
        super().__post_init__()

    @property
    def counted(self) -> NDArray[np.bool_]:
        """(n,) mask of the ticks of the statistics, from time 0 to the end of the reference."""
        return np.asarray(self.time <= self.reference.duration + TIME_TOLERANCE)

    @cached_property
    def errors(self) -> TrackingErrors:
        """Tracking errors over time."""
        expected = ReferenceSample(self.reference_pose, self.reference_twist, self.reference_arc_length)
        return tracking_errors(self.reference, expected, self.true_pose, self.true_twist)

    @cached_property
    def metrics(self) -> Metrics:
        """Statistics from time 0 to the end of the reference."""
        return compute_metrics(self)

    @cached_property
    def recovery(self) -> Recovery:
        """Recovery of the run after the disturbance, up to the end of the reference."""
        counted, band = self.counted, metric_settings().band
        lateral, command = self.errors.lateral[counted], self.command[counted]
        return compute_recovery(
            self.time[counted], lateral, command, self.sample_time, self.disturbance, band, lost=bool(self.ended)
        )

    @property
    def wheel_twist(self) -> FloatArray:
        """(n, 2) measured v [m/s] and omega [rad/s] of the wheels; NaN at ticks without a new reading."""
        return self._measured([m.wheel_twist for m in self.measurements], 2)

    @property
    def wheel_speeds(self) -> FloatArray:
        """(n, 4) measured wheel speeds [rad/s], in the order of the wheels; NaN at ticks without a new reading."""
        return self._measured([m.wheel_speeds for m in self.measurements], 4)

    @property
    def gyro(self) -> FloatArray:
        """(n,) measured yaw rate [rad/s]; NaN at ticks without a new reading."""
        return self._measured([m.yaw_rate for m in self.measurements], 1)[:, 0]

    @property
    def measured_pose(self) -> FloatArray:
        """(n, 3) received pose x [m], y [m], theta [rad]; NaN at ticks without a new pose."""
        return self._measured([m.pose for m in self.measurements], 3)

    @property
    def measured_pose_time(self) -> FloatArray:
        """(n,) time of validity of the received pose [s]; NaN at ticks without a new pose."""
        times = [None if m.pose is None else replace(m.pose, value=m.pose.time) for m in self.measurements]
        return self._measured(times, 1)[:, 0]

    @property
    def columns(self) -> Mapping[str, NDArray[Any]]:
        """Time series (n,) by name: numbers with a unit suffix, NaN if missing, and strings.

        `v_ref` and `omega_ref` are the sent command, `pose_t` is the time of validity of the received pose, and `sd` is
        the standard deviation of an estimate. Other names correspond to the attributes of `Run`.
        """
        body, motion = ("x_m", "y_m", "theta_rad"), ("v_m_s", "omega_rad_s")
        deviations = ("x_sd_m", "y_sd_m", "theta_sd_rad", "v_sd_m_s", "omega_sd_rad_s")
        wheels = tuple(f"wheel_{wheel}_rad_s" for wheel in ("fl", "fr", "rl", "rr"))
        series = [
            (("t_s",), self.time),
            (("v_ref_m_s", "omega_ref_rad_s"), self.command),
            (("v_wheel_m_s", "omega_wheel_rad_s"), self.wheel_twist),
            (wheels, self.wheel_speeds),
            (("omega_gyro_rad_s",), self.gyro),
            (("pose_t_s",), self.measured_pose_time),
            (_column_names("pose", body), self.measured_pose),
            (_column_names("true", body), self.true_pose),
            (_column_names("true", ("v_m_s", "lateral_m_s", "omega_rad_s")), self.true_twist),
            (_column_names("reference", body), self.reference_pose),
            (_column_names("reference", motion), self.reference_twist),
            (_column_names("estimate", (*body, *motion)), self.estimates),
            (_column_names("estimate", deviations), self.estimate_deviations),
            (("step_time_s", "solve_time_s"), np.column_stack([self.step_time, self.solve_time])),
            (("solver_iterations",), self.solver_iterations),
        ]
        finite = np.flatnonzero(np.isfinite(self.scalars).any(axis=0))
        names = tuple(step_scalars())
        series.append((tuple(names[column] for column in finite), self.scalars[:, finite]))
        if np.isfinite(self.motor_torque).any():
            series += [
                (tuple(f"true_{quantity}_{wheel}_{unit}" for wheel in ("fl", "fr", "rl", "rr")), rows)
                for quantity, unit, rows in (
                    ("torque", "n_m", self.motor_torque),
                    ("motor_power", "w", self.motor_power),
                    ("torque_square", "n2_m2", self.motor_square),
                )
            ]
        columns = {
            name: column for names, rows in series for name, column in zip(names, np.atleast_2d(rows.T), strict=True)
        }
        texts = {
            "mode": self.modes,
            "solver_status": self.solver_statuses,
            "solver_path": self.solver_methods,
            "message": self.messages,
        }
        columns |= reported_columns(self.measurements, len(self.time))
        for part in columns_of(self):
            columns |= part.series(self)
        return {**columns, **{name: np.array(values, dtype=object) for name, values in texts.items()}}

    @checked_call("run.to_dataframe().to_csv('run.csv') writes the table")
    def to_dataframe(self) -> DataFrame:
        """Convert the run to a pandas DataFrame with one row per tick and the names of `columns`.

        Raises
        ------
        models.errors.MissingPackageError
            If pandas is not installed.
        """
        frame: DataFrame = load_pandas("run.to_dataframe()").DataFrame(dict(self.columns))
        return frame

    @checked_call("run.plot().savefig('run.png') saves the figure")
    def plot(self) -> Figure:
        """Plot path, errors and commands in a matplotlib figure.

        `matplotlib.pyplot.show()` shows the figure, `run.plot().savefig("run.png")` saves it.

        Raises
        ------
        models.errors.MissingPackageError
            If matplotlib is not installed.
        """
        from diffdrive_mpc.sim.run_plot import plot_run  # noqa: PLC0415 - matplotlib loads slowly

        return plot_run(self)

    def __str__(self) -> str:
        """Format the statistics as a table."""
        return f"{self!r}\n{self.metrics}"

    def __repr__(self) -> str:
        """Describe the run in one line."""
        return f"Run along {self.reference.name!r}: {len(self.time)} ticks of {self.sample_time:g} s" + (
            f", ended: {self.ended}" if self.ended else ""
        )

    def with_step_time(self, step_time: ArrayLike, solve_time: ArrayLike | None = None) -> Self:
        """Return the run with computation times (n,) [s] of a separate run for timing; statistics exclude NaN.

        Raises ValueError if the number of times is not n.
        """
        times = [
            np.asarray(series, dtype=float)
            for series in (step_time, self.solve_time if solve_time is None else solve_time)
        ]
        for time in times:
            if time.shape != self.time.shape:
                raise ValueError(f"{time.shape} step times for a run of {len(self.time)} ticks")
        timed = replace(self, step_time=times[0], solve_time=times[1])
        vars(timed)["errors"] = self.errors  # the motion is unchanged
        return timed

    def _measured(self, values: list[Stamped | None], width: int) -> FloatArray:
        empty = np.full(width, np.nan)
        rows = [empty if value is None else np.asarray(value.value, dtype=float).reshape(width) for value in values]
        return np.array(rows or [empty] * len(self.time)).reshape(-1, width)


def _column_names(quantity: str, parts: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{quantity}_{part}" for part in parts)


def reported_columns(measurements: Sequence[Measurement], count: int) -> dict[str, FloatArray]:
    """Return the columns (count,) named in `INPUT_NAMES`, NaN for missing values; `measurements` may be empty."""
    rows = [measured_cells(measurement) for measurement in measurements] or [{}] * count
    return {name: np.array([row.get(name, np.nan) for row in rows], dtype=float) for name in INPUT_NAMES}
