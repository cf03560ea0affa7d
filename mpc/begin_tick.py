"""What one tick's problem is about: where the robot is, what the reference asks, and what follows without a plan."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, ReferenceSample
from diffdrive_mpc.mpc.estimate import Estimate
from diffdrive_mpc.mpc.feed_forward import FeedForward
from diffdrive_mpc.mpc.lean import lean
from diffdrive_mpc.mpc.problem import TrackingProblem
from diffdrive_mpc.mpc.tick import Tick


def begin_tick(
    problem: TrackingProblem,
    feed_forward: FeedForward,
    estimate: Estimate,
    past: FloatArray,
    last_command: FloatArray,
    sample: ReferenceSample,
) -> Tick:
    """The data of the problem.

    `past` (memory, 2) are the commands on their way, `last_command` (2,) is the one that slew counts from, and `sample`
    is the reference now and at the ticks to come.
    """
    poses = sample.pose[: problem.steps + 1].copy()
    # The estimate counts its turns itself: meet it on the turn it is on.
    poses[:, 2] += 2 * np.pi * np.round((estimate.pose[2] - poses[0, 2]) / (2 * np.pi))
    slip = estimate.slip
    aim, heading = lean(poses, sample.twist[: len(poses)], slip.side_slip, problem.config.weights)
    free = problem.prediction.free_twists(estimate.state, past).reshape(-1, 2)
    return Tick(
        pose=estimate.pose,
        free_twist=slip.gains * (free + slip.offset),
        gains=slip.gains,
        side_slip=slip.side_slip,
        reference=aim,
        heading=heading,
        feed_forward=feed_forward.commands(sample.twist, slip),
        last_command=last_command,
    )
