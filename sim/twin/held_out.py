"""A twin and the identified model held against the rows that neither was made from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diffdrive_mpc.models.base_effects import PoseMount
from diffdrive_mpc.models.identification.poses import PoseDrift, pose_drift
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import Experiment, joined, parted
from diffdrive_mpc.models.output_error.validation import pooled_fit_percent
from diffdrive_mpc.models.results import ReadOnlyArrays
from diffdrive_mpc.sim.twin.fitting import TwinFit
from diffdrive_mpc.sim.twin.free_run import drive, readings, stretch
from diffdrive_mpc.sim.twin.identified import Identified


@dataclass(frozen=True)
class Prediction(ReadOnlyArrays):
    """What one of them says of one record.

    Attributes
    ----------
    readings
        (K, p) v and omega of the encoders and, with a gyro, its omega; the model's own two where p is 2.
    body
        (K, 2) v in metres of the encoders [m/s] and true yaw rate [rad/s].
    """

    readings: FloatArray
    body: FloatArray


@dataclass(frozen=True)
class Held:
    """How well one of them predicts.

    Attributes
    ----------
    fit_percent
        FIT of "v", "omega", and of the twin "omega of the encoders" [%], pooled over the records.
    drift
        Error of the pose at each horizon; empty without poses.
    predictions
        For each record.
    """

    fit_percent: Mapping[str, float]
    drift: tuple[PoseDrift, ...]
    predictions: tuple[Prediction, ...]


def hold_model(model: Identified, experiments: Sequence[Experiment]) -> list[Prediction]:
    """What the identified model predicts; one free run over each run without gaps."""
    runs = joined(experiments)
    seen = parted([model.readings(run) for run in runs], experiments)
    body = parted([model.body(run) for run in runs], experiments)
    return [Prediction(*both) for both in zip(seen, body, strict=True)]


def hold_twin(fit: TwinFit, model: Identified, experiments: Sequence[Experiment]) -> list[Prediction]:
    """What the twin predicts, as `hold_model`."""
    runs = joined(experiments)
    stretches = [stretch(run, 0, run.samples, model.model.dc_gain) for run in runs]
    motions = drive(fit.robot, stretches)
    seen = parted([readings(motion, run, fit.values) for motion, run in zip(motions, runs, strict=True)], experiments)
    twists = [motion.twist() for motion in motions]
    body = parted([twist[:, [0, 2]] for twist in twists], experiments)
    return [Prediction(*both) for both in zip(seen, body, strict=True)]


def fit_percent(predictions: Sequence[Prediction], experiments: Sequence[Experiment]) -> dict[str, float]:
    """FIT [%] of v and omega, and of omega of the encoders where it is predicted beside the gyro's."""
    width = experiments[0].outputs.shape[1]
    columns = {"v": (0, 0), "omega": (-1, -1)}
    if predictions[0].readings.shape[1] == width and width > len(columns):
        columns["omega of the encoders"] = (1, 1)
    return {
        name: pooled_fit_percent(
            [run.outputs[run.counts[:, there], there] for run in experiments],
            [one.readings[run.counts[:, there], here] for one, run in zip(predictions, experiments, strict=True)],
        )
        for name, (here, there) in columns.items()
    }


def drift_of(
    records: Sequence[Record],
    predictions: Sequence[Prediction],
    mount: Mapping[str, float] | None,
    *,
    travel: float,
    on_missing: Callable[[str], None] = lambda _words: None,
) -> tuple[PoseDrift, ...]:
    """Open-loop error of the pose about the centre of rotation; empty without poses.

    Parameters
    ----------
    records
        Those that were predicted.
    predictions
        One for each.
    mount
        "pose.delay", "mount.ahead", "mount.left", "mount.heading", as `models.identification.effects.pose_sensor`.
    travel
        Metres travelled for each metre of v in the predictions [-].
    on_missing
        Called with the reason where a horizon is longer than the records.
    """
    if mount is None:
        return ()
    place = PoseMount(**{name: mount[f"mount.{name}"] for name in ("ahead", "left", "heading")})
    posed, twists = [], []
    for record, one in zip(records, predictions, strict=True):
        if record.pose is not None:
            posed.append(replace(record, pose=place.centre(record.pose)))
            twists.append(one.body * np.array([travel, 1.0]))
    found: list[PoseDrift] = []
    for horizon in identification_settings().horizons:
        try:
            found += pose_drift(posed, twists, pose_lag=max(mount["pose.delay"], 0.0), horizons=[horizon])
        except ValueError as error:
            on_missing(str(error))
    return tuple(found)
