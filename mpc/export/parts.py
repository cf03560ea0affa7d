"""What an exported controller is made of: the same parts that `mpc.Controller` builds for itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from diffdrive_mpc.mpc.condensed import Condenser
from diffdrive_mpc.mpc.estimator import build_filter, history_ticks
from diffdrive_mpc.mpc.feed_forward import FeedForward
from diffdrive_mpc.mpc.kalman import SlipFilter
from diffdrive_mpc.mpc.tick import Tick

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc.mpc.estimation.slip import Slip
from diffdrive_mpc.mpc.problem import TrackingProblem

# Share of the speed limit at which the typical tick drives straight ahead.
_TYPICAL_SPEED = 0.5


@dataclass(frozen=True)
class Parts:
    """Everything that constants are taken from."""

    config: ControllerConfig
    model: VelocityModel
    sampled: DiscreteModel
    slip_filter: SlipFilter
    problem: TrackingProblem
    feed_forward: FeedForward

    @property
    def history(self) -> int:
        """Ticks that the estimator's history holds."""
        return history_ticks(self.config.estimator, self.sampled.dt)

    def typical_program(self) -> tuple[FloatArray, FloatArray]:
        """Hessian (2 N, 2 N) and rows of the soft limits (5, N, 2 N) of a robot that drives straight ahead."""
        N, dt = self.config.horizon, self.sampled.dt
        speed = _TYPICAL_SPEED * self.config.limits.v
        poses = np.zeros((N + 1, 3))
        poses[:, 0] = speed * dt * np.arange(N + 1)
        slip = Slip()
        command = np.asarray(np.linalg.solve(self.sampled.dc_gain, [speed, 0.0]), dtype=float)
        tick = Tick(
            pose=poses[0],
            free_twist=np.zeros((N + 1, 2)),
            gains=slip.gains,
            side_slip=slip.side_slip,
            reference=poses,
            heading=poses[:, 2],
            feed_forward=np.tile(command, (N, 1)),
            last_command=command,
        )
        program = Condenser(self.problem).condense(tick, tick.feed_forward)
        return program.H.copy(), program.soft.copy()


def build_parts(config: ControllerConfig) -> Parts:
    """Build them; raises as `mpc.Controller` does."""
    model = Controller(config).model
    sampled = model.discretise(config.sample_time)
    return Parts(
        config=config,
        model=model,
        sampled=sampled,
        slip_filter=build_filter(sampled, config.estimator, config.compensation, config.wheels),
        problem=TrackingProblem(config, sampled),
        feed_forward=FeedForward(model, config.sample_time, config.horizon),
    )
