"""Our controller as a subject of the study."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.mpc import Controller, StepResult, load_trajectory
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.step_result import Mode
from studies.speed.subjects import SolveReport


class OurSubject:
    """Our controller; the time inside the solver includes linearisation, condensing and the solution of the QP.

    Parameters
    ----------
    config
        Configuration of the controller.
    settings
        Name of the `trajectory`.
    folder
        Not used, because the controller stores its generated code in a cache folder.
    """

    def __init__(self, config: ControllerConfig, settings: dict[str, Any], folder: Path) -> None:
        del folder
        self._controller = Controller(config)
        self._reference = load_trajectory(settings["trajectory"])
        self._step: StepResult | None = None

    def reset(self, t: float, measurement: Measurement) -> None:
        """Reset the controller for a drive that starts at `t` [s]."""
        del measurement
        self._controller.reset()
        self._controller.start(self._reference, t)

    def solve(self, t: float, measurement: Measurement) -> FloatArray:
        """Compute the command (2,) for the measurement at `t` [s]."""
        self._step = self._controller.step(t, measurement)
        return self._step.command

    def report(self) -> SolveReport:
        """Return the report of the last step."""
        step = self._step
        assert step is not None
        return SolveReport(step.solve_time, step.solver.iterations, step.mode is Mode.TRACKING)
