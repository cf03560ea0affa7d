"""MBM and SM from steps, held against each other on trajectories (Guffanti et al., Sensors 2025, 25(11), 3553)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from diffdrive_mpc.bench.reproduce.experiments.odometry import PoseError, pose_error, predict_path, sampled
from diffdrive_mpc.bench.reproduce.experiments.robot_logs import STEP_KINDS, RobotLogs
from diffdrive_mpc.bench.reproduce.study import MbmSmStudy
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import wheel_experiments
from diffdrive_mpc.models.output_error.validation import pooled_fit_percent, simulate_experiment, validate
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.structures.mbm import identify_mbm
from diffdrive_mpc.models.structures.sm import identify_sm

MBM, MBM_TRACKS, SM = "MBM", "MBM, own tracks", "SM"
COMPARED = (MBM, MBM_TRACKS, SM)
"""MBM as the paper has it, MBM with identified tracks, SM."""
DATA = ("steps used", "steps held out", "free drives")


@dataclass(frozen=True)
class MbmSmResult:
    """One repetition.

    Attributes
    ----------
    repetition
        Its number.
    motor_fit
        By data, FIT of the motors front left, front right, rear left, rear right [%].
    sm_fit
        By data, FIT of v and omega [%].
    errors
        By model and trajectory.
    paths
        By trajectory, the driven poses (K, 3) under the name "driven" and those that the models predict.
    parameters
        By model, what the identification found.
    warnings
        By model, what it did not trust.
    """

    repetition: int
    motor_fit: Mapping[str, tuple[float, ...]]
    sm_fit: Mapping[str, tuple[float, float]]
    errors: Mapping[str, Mapping[str, PoseError]]
    paths: Mapping[str, Mapping[str, FloatArray]]
    parameters: Mapping[str, Mapping[str, Any]]
    warnings: Mapping[str, tuple[str, ...]]


def compare_mbm_and_sm(study: MbmSmStudy, repetition: int) -> MbmSmResult:
    """Identify MBM and SM from the paper's steps and predict the paper's trajectories.

    The paper turns commands into wheel speeds, and these into twists, with the robot's geometric track: that is "MBM".
    "MBM, own tracks" has the track of the firmware and the one that the gyro asks for, both identified.
    """
    logs, robot = RobotLogs(repetition), load_robot()
    used, held_out = ({kind: logs.steps(kind) for kind in STEP_KINDS} for _ in range(2))
    free = logs.free(study.free_drives, study.free_duration)
    own_tracks = identify_mbm([*used["wheels"], *used["omega"]], robot.wheel_radius)
    sm = identify_sm([*used["v"], *used["omega"]], limits=False)
    geometric = {"firmware_track": robot.track, "effective_track": robot.track}
    mbm = replace(own_tracks, content={**own_tracks.content, **geometric})
    models = {MBM: mbm, MBM_TRACKS: own_tracks, SM: sm}
    paths = {name: _paths(models, logs.trajectory(name)) for name in study.trajectories}
    of_motors = dict(zip(DATA, (used["wheels"], held_out["wheels"], free), strict=True))
    # Each channel has steps of its own, as in the paper.
    of_v = dict(zip(DATA, (used["v"], held_out["v"], free), strict=True))
    of_omega = dict(zip(DATA, (used["omega"], held_out["omega"], free), strict=True))
    return MbmSmResult(
        repetition,
        motor_fit={name: motor_fit(own_tracks, records) for name, records in of_motors.items()},
        sm_fit={name: (_fit(sm, of_v[name], 0), _fit(sm, of_omega[name], 1)) for name in DATA},
        errors={
            model: {name: pose_error(found[model], found["driven"]) for name, found in paths.items()}
            for model in models
        },
        paths=paths,
        parameters={MBM: own_tracks.content, SM: sm.content},
        warnings={MBM: own_tracks.warnings, SM: sm.warnings},
    )


def motor_fit(mbm: IdentifiedModel, records: Sequence[Record]) -> tuple[float, ...]:
    """FIT of each motor's speed, simulated from the commands [%], pooled over records."""
    experiments = wheel_experiments(records)
    simulated = [simulate_experiment(mbm.fits[0].system, experiment) for experiment in experiments]
    return tuple(
        pooled_fit_percent(
            [experiment.outputs[:, motor] for experiment in experiments], [y[:, motor] for y in simulated]
        )
        for motor in range(experiments[0].outputs.shape[1])
    )


def _fit(sm: IdentifiedModel, records: Sequence[Record], channel: int) -> float:
    return float(validate(sm.system, records).fit_percent[channel])


def _paths(models: Mapping[str, IdentifiedModel], driven: Record) -> dict[str, FloatArray]:
    pose = np.asarray(driven.pose)
    predicted = {
        name: predict_path(sampled(identified.system, driven.dt), driven.command, pose[0])
        for name, identified in models.items()
    }
    return {"driven": pose, **predicted}
