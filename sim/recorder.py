"""Recording of the ticks of the closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import (
    AnyArray,
    ControlStep,
    FloatArray,
    Measurement,
    MotionEstimate,
    Reference,
)
from diffdrive_mpc.models.step_scalars import scalar_row
from diffdrive_mpc.sim.plants.drivetrain import NO_WORK, MotorWork, motor_work, stack
from diffdrive_mpc.sim.plants.plant import Plant, PlantAround
from diffdrive_mpc.sim.run import NO_SOLVER, Run


class Recorder:
    """Recorder of a run, tick by tick.

    Parameters
    ----------
    ticks
        Maximum number of ticks.
    keep_plans
        True to store the plan of the controller at each tick.
    lean
        True to store neither measurements nor computation times.
    """

    def __init__(self, ticks: int, *, keep_plans: bool, lean: bool = False) -> None:
        self._keep_plans, self._lean = keep_plans, lean
        self._time = np.empty(ticks)
        self._true_pose, self._true_twist = np.empty((ticks, 3)), np.empty((ticks, 3))
        self._command, self._step_time = np.empty((ticks, 2)), np.full(ticks, np.nan)
        self._solve_time, self._iterations = np.full(ticks, np.nan), np.full(ticks, np.nan)
        self._estimates, self._deviations = np.full((ticks, 5), np.nan), np.full((ticks, 5), np.nan)
        self._reports: list[_StepReport] = []
        self._measurements: list[Measurement] = []
        self._plans: list[FloatArray | None] = []
        self._work: list[MotorWork] = []
        self._readings: dict[str, list[FloatArray]] = {}

    def record_state(self, plant: Plant, measurement: Measurement | None) -> None:
        """Record the true state and the measurement at the start of a tick."""
        k = len(self._reports)
        self._time[k], self._true_pose[k], self._true_twist[k] = plant.time, plant.true_pose, plant.true_twist
        for name, part in getattr(plant, "parts", {}).items():
            self._readings.setdefault(name, []).append(part.value)
        if measurement is not None and not self._lean:
            self._measurements.append(measurement)

    def record_step(self, step: ControlStep, command: FloatArray) -> None:
        """Record the step of the controller and its `command` (2,)."""
        k = len(self._reports)
        self._command[k] = command
        if not self._lean:
            self._step_time[k], self._solve_time[k] = step.step_time, step.solve_time
        if step.solver is not None:
            self._iterations[k] = step.solver.iterations
        estimate: MotionEstimate | None = getattr(step, "estimate", None)
        if estimate is not None:
            self._estimates[k, :3], self._estimates[k, 3:] = estimate.pose, estimate.twist
            self._deviations[k, :3], self._deviations[k, 3:] = estimate.pose_deviation, estimate.twist_deviation
        self._reports.append(_StepReport.of_step(step))
        if self._keep_plans:
            self._plans.append(step.plan)

    def columns(self, pose: FloatArray, twist: FloatArray, step: ControlStep) -> list[tuple[FloatArray, FloatArray]]:
        """Return pairs of an array with the values of a tick, and of the table whose row k stores them at tick k.

        `pose` (3,) and `twist` (3,) are the true state of the plant. The controller updates the arrays of `step` in
        place at each tick.
        """
        estimate: MotionEstimate = step.estimate  # type: ignore[attr-defined]
        return [
            (pose, self._true_pose),
            (twist, self._true_twist),
            (step.command, self._command),
            (estimate.pose, self._estimates[:, :3]),
            (estimate.twist, self._estimates[:, 3:]),
            (estimate.pose_deviation, self._deviations[:, :3]),
            (estimate.twist_deviation, self._deviations[:, 3:]),
        ]

    def record_ticks(self, times: FloatArray, steps: Sequence[ControlStep], iterations: AnyArray) -> None:
        """Record times, reports and iterations of ticks in C, which have already filled their rows of `columns`.

        The plant has no motors.
        """
        rows = slice(len(self._reports), len(self._reports) + len(times))
        self._time[rows], self._iterations[rows] = times, iterations
        reports = {id(step): _StepReport.of_step(step) for step in dict.fromkeys(steps)}
        self._reports += [reports[id(step)] for step in steps]
        self._work += [NO_WORK] * len(times)

    def record_work(self, plant: Plant, *, lost: bool) -> None:
        """Record the motor work of the sample; `NO_WORK` if the robot was `lost` during the sample."""
        self._work.append(NO_WORK if lost else motor_work(plant))

    def run(self, plant: Plant, reference: Reference, *, ended: str) -> Run:
        """Return the recorded run along `reference`; `ended` is the reason for an early end, otherwise empty."""
        recorded = slice(len(self._reports))
        time = self._time[recorded]
        expected = reference.sample(time)
        torque, wheel_speed, mechanical, square = stack(self._work)
        return Run(
            reference=reference,
            sample_time=plant.sample_time,
            time=time,
            true_pose=self._true_pose[recorded],
            true_twist=self._true_twist[recorded],
            reference_pose=expected.pose,
            reference_twist=expected.twist,
            reference_arc_length=expected.arc_length,
            command=self._command[recorded],
            step_time=self._step_time[recorded],
            solve_time=self._solve_time[recorded],
            solver_iterations=self._iterations[recorded],
            modes=tuple(report.mode for report in self._reports),
            messages=tuple(report.message for report in self._reports),
            states=tuple(report.state for report in self._reports),
            measurements=tuple(self._measurements),
            solver_statuses=tuple(report.solver_status for report in self._reports),
            solver_methods=tuple(report.solver_path for report in self._reports),
            estimates=self._estimates[recorded],
            estimate_deviations=self._deviations[recorded],
            plans=_stack_plans(self._plans),
            motor_torque=torque,
            motor_speed=wheel_speed,
            motor_power=mechanical,
            motor_square=square,
            parts=getattr(plant, "records", {})
            | {name: part.record(np.array(self._readings[name])) for name, part in getattr(plant, "parts", {}).items()},
            scalars=np.array([report.scalars for report in self._reports]),
            disturbance=getattr(plant, "disturbance", None) if isinstance(plant, PlantAround) else None,
            ended=ended,
        )


class _StepReport(NamedTuple):
    """Texts and scalars of a step."""

    mode: str
    message: str
    solver_status: str
    solver_path: str
    scalars: list[float]
    state: str

    @classmethod
    def of_step(cls, step: ControlStep) -> _StepReport:
        """Extract texts and scalars of `step`."""
        solver, state = step.solver, str(getattr(step, "state", step.mode))
        status, method = ("", NO_SOLVER) if solver is None else (str(solver.status), str(solver.method))
        return cls(str(step.mode), step.message, status, method, scalar_row(step), state)


def _stack_plans(plans: Sequence[FloatArray | None]) -> FloatArray:
    """Stack the plans of n ticks as (n, N + 1, 3) with NaN for missing plans; (n, 0, 3) without plans."""
    poses = next((len(plan) for plan in plans if plan is not None), 0)
    missing = np.full((poses, 3), np.nan)
    return np.array([missing if plan is None else plan for plan in plans], dtype=float).reshape(len(plans), poses, 3)
