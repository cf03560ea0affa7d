"""do-mpc with IPOPT as a peer: the predictive controller's problem, solved to convergence at every tick.

It runs in a process of its own, in the environment that the study `speed` makes, and is told what our controller knows:
its estimate, reference and feed-forward. It is never a dependency.
"""

from __future__ import annotations

import tempfile
import time
import weakref
from dataclasses import asdict
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.peers import PeerStep
from diffdrive_mpc.bench.studies.speed.drive import PeerInput
from diffdrive_mpc.bench.studies.speed.process.environment import peer_environment
from diffdrive_mpc.bench.studies.speed.process.subject import Subject
from diffdrive_mpc.bench.studies.speed.settings import load_speed_settings
from diffdrive_mpc.bench.studies.speed.stage import stage_problem
from diffdrive_mpc.models.interface import Measurement, Reference
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.mpc.problem.build import chosen_model

_MODEL, _SUBJECT = "ssm", "do-mpc"


class DoMpcController:
    """The problem of the SSM with the shipped horizon and weights; IPOPT's options are those of the study `speed`."""

    def __init__(self) -> None:
        self._config = load_config(_MODEL)
        model = chosen_model(self._config, None)
        assert isinstance(model, VelocityModel)
        self._model = model
        self._subject: Subject | None = None
        self._input: PeerInput | None = None

    def start(self, reference: Reference, t0: float) -> None:
        """Begin to track `reference`, whose time 0 is `t0` [s]; the first time, start the process.

        Raises SubjectError if its environment cannot be made.
        """
        if self._subject is None:
            self._subject = self._start_process()
        self._input = PeerInput(self._config, self._model, reference)
        self._end, self._fresh = t0 + reference.duration, True

    def step(self, t: float, measurement: Measurement) -> PeerStep:
        """Decide the command for the tick at `t` [s].

        Raises RuntimeError if `start` was not called, or the first tick has no pose.
        """
        began = time.perf_counter()
        if self._subject is None or self._input is None:
            raise RuntimeError("call start(reference, t0) before step")
        if t >= self._end:
            command = self._input.sent(np.zeros(2))
            return PeerStep(command, "FINISHED", "", time.perf_counter() - began)
        data = self._input.data(t, measurement)
        if self._fresh:
            self._subject.reset(data)
            self._fresh = False
        ((step,), _) = self._subject.run([data])
        sound = step.solved and bool(np.isfinite(step.command).all())
        command = self._input.sent(np.array(step.command) if sound else np.zeros(2))
        message = "" if sound else "IPOPT did not converge"
        return PeerStep(command, "TRACKING" if sound else "BRAKING", message, time.perf_counter() - began, step.inside)

    def _start_process(self) -> Subject:
        environment = peer_environment()
        folder = tempfile.TemporaryDirectory()
        subject = Subject(_SUBJECT, Path(folder.name), environment.python, environment.variables)
        weakref.finalize(self, folder.cleanup)
        weakref.finalize(self, subject.__exit__, None, None, None)
        problem = stage_problem(self._config, self._model.discretise(self._config.sample_time))
        subject.build(asdict(problem), load_speed_settings().subjects[_SUBJECT].settings, None)
        return subject
