"""Our controller as a subject: the whole step from measurement to command, and the planner alone for its inner time."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from diffdrive_mpc.bench.studies.speed.subjects import SolveReport
from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.mpc import Controller, StepResult, load_trajectory
from diffdrive_mpc.mpc.command_line import CommandLine
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.planner import Planner
from diffdrive_mpc.mpc.step_result import Mode


class OurSubject:
    """The controller, beside it a second planner that gets what the controller's got.

    The time inside the solver is that of the planner: the problem's data from estimate and reference, linearisation,
    quadratic program and plan, as acados counts it. It is taken outside the time of the step.

    Parameters
    ----------
    config
        The configuration.
    settings
        `trajectory` by name.
    folder
        Not used: the core keeps its own.
    """

    def __init__(self, config: ControllerConfig, settings: dict[str, Any], folder: Path) -> None:
        del folder
        self._controller = Controller(config)
        self._reference = load_trajectory(settings["trajectory"])
        self._planner = Planner(config, self._controller.model)
        self._line = CommandLine(self._controller.model.discretise(config.sample_time), 0)
        self._step: StepResult | None = None
        self._time = 0.0

    def reset(self, t: float, measurement: Measurement) -> None:
        """Be as new at the first tick, which is at `t`."""
        del measurement
        self._controller.reset()
        self._controller.start(self._reference, t)
        self._planner.reset()
        self._line.clear()

    def solve(self, t: float, measurement: Measurement) -> FloatArray:
        """The command (2,) for the measurement at `t` [s]."""
        self._time, self._step = t, self._controller.step(t, measurement)
        return self._step.command

    def report(self) -> SolveReport:
        """Of the last step."""
        step = self._step
        assert step is not None
        inside = 0.0
        if step.mode is Mode.TRACKING and step.estimate is not None:
            data = (step.estimate, self._line.recent, self._line.last, self._reference, self._time)
            began = time.perf_counter()
            self._planner.plan(*data)
            inside = time.perf_counter() - began
        self._line.append(step.command)
        return SolveReport(inside, step.solver.iterations, step.mode is Mode.TRACKING)
