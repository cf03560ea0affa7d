"""Tubes from simulated drives of the identified robot, with drawn model errors, residual motion and sensor noise."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter1d

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import case_config, load_reference
from diffdrive_mpc.bench.drive import plant_settings
from diffdrive_mpc.bench.runner import run_tasks
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.load import is_shipped
from diffdrive_mpc.models.logs.drive_log.reader import read_drive_log
from diffdrive_mpc.models.pose import ahead_and_left
from diffdrive_mpc.mpc import Controller, ControllerConfig, load_config
from diffdrive_mpc.sim import Run, make_plant, simulate
from diffdrive_mpc.sim.plants.make import identified_robot_of
from diffdrive_mpc_extras.campaign.rates import conformal_quantile
from diffdrive_mpc_extras.predicted_error.predicted_error import ErrorTube, PredictedError
from diffdrive_mpc_extras.replay.reference import logged_reference

MODEL_ERROR = 1.1
"""Factor that widens the tubes of simulated drives to account for differences between model structure and robot.

Tuned on mujoco:hauler, mujoco:long_naive and eight robots with independent physics; the maximum required factor was
1.12.
"""
DRAWS = 60
"""Default number of simulated drives; the tube of whole drives needs at least level / (1 - level)."""
LEVEL = 0.95
_WINDOW = 1.0
"""Time over which squared errors are averaged for the shape of a tube [s]."""
_MEAN_SHARE = 0.5
"""Share of the path's mean error in the width at each position, which keeps the tube open on straight sections [-]."""


def drive_case(config: str, trajectory: str, plant: str, seed: int) -> Case:
    """Return the case of one simulated drive."""
    model, file = (config, None) if is_shipped(config) else (load_config(config).model, config)
    return Case(model=model, config=file, trajectory=trajectory, plant=plant, seed=seed)


def absolute_errors(run: Run, count: int) -> tuple[FloatArray, FloatArray]:
    """Return |lateral| and |along| (count,) [m] at the samples of the reference; infinite if the drive ended early."""
    along, _ = ahead_and_left(run.true_pose - run.reference_pose, run.reference_pose[:, 2])
    lateral, ahead = np.full((2, count), np.inf)
    samples = min(count, len(run.time)) if run.metrics.completed else 0
    for errors, values in ((lateral, run.errors.lateral), (ahead, along)):
        errors[:samples] = np.abs(values[:samples])
        # A robot that reaches the goal early stays there.
        errors[samples:] = errors[samples - 1] if samples else np.inf
    return lateral, ahead


def tube(errors: FloatArray, dt: float, level: float = LEVEL, cause: str = "") -> ErrorTube:
    """Compute the tube from the errors (m, n) [m] of m drives with sample time `dt` [s].

    The width is a multiple of the root mean square over drives and neighbouring positions. The errors of each drive are
    divided by the width from the other drives (jackknife); the multiples are conformal quantiles of these ratios.

    Raises ConfigError if too few drives arrive for the level; the error states `cause`, messages of the lost drives.
    """
    finite_errors = errors[np.isfinite(errors).all(axis=1)]
    squares = uniform_filter1d(finite_errors**2, max(1, round(_WINDOW / dt)), axis=1, mode="nearest")
    total = squares.sum(axis=0)

    def width(sums: FloatArray, count: int) -> FloatArray:
        local = np.sqrt(sums / count)
        return np.asarray((1.0 - _MEAN_SHARE) * local + _MEAN_SHARE * local.mean())

    count = max(1, len(finite_errors) - 1)
    ratios = [row / width(total - square, count) for row, square in zip(finite_errors, squares, strict=True)]
    ratios += [np.full(errors.shape[1], np.inf)] * (len(errors) - len(finite_errors))
    everywhere = conformal_quantile([ratio.max(keepdims=True) for ratio in ratios], level)
    if not np.isfinite(everywhere):
        reason = f"; most frequent messages of the lost drives: {cause}" if cause else ""
        raise ConfigError(
            f"{len(finite_errors)} of {len(errors)} simulated drives arrive: too few for {100 * level:g} %{reason}; "
            "correct the cause, drive at another speed, or give more --draws"
        )
    scale = width(total, len(finite_errors))
    return ErrorTube(conformal_quantile(ratios, level) * scale, everywhere * scale, {})


def predict_by_drives(
    config: str,
    trajectory: str,
    plant: str,
    draws: int = DRAWS,
    jobs: int = 1,
    on_done: Callable[[], None] = lambda: None,
) -> PredictedError:
    """Predict the tracking error of a trajectory from simulated drives on a plant.

    Parameters
    ----------
    config, trajectory, plant
        Names or files, as for `simulate`.
    draws
        Number of drives, with seeds from 0. `MODEL_ERROR` widens their tubes.
    jobs
        Number of processes.
    on_done
        Callback after each drive.

    Raises
    ------
    ConfigError, ValueError
        If a name is unknown, a file is invalid, or too few drives arrive.
    """
    case = drive_case(config, trajectory, plant, 0)
    return predict_reference(load_reference(case), case_config(case), plant, draws, jobs, on_done)


def predict_reference(
    reference: Reference,
    config: ControllerConfig,
    plant: str,
    draws: int = DRAWS,
    jobs: int = 1,
    on_done: Callable[[], None] = lambda: None,
) -> PredictedError:
    """Predict the tracking error of a reference with a configuration; parameters and errors as `predict_by_drives`."""
    dt = config.sample_time
    time = np.asarray(np.arange(max(2, int(reference.duration / dt) + 1)) * dt, dtype=np.float64)
    tasks = [partial(_drive, reference, config, plant, seed, len(time)) for seed in range(draws)]
    errors, messages = zip(*run_tasks(tasks, jobs, on_done), strict=True)
    results, sample = np.array(errors), reference.sample(time)
    cause = ", ".join(_most_frequent(chain.from_iterable(messages)))
    if robot := identified_robot_of(plant):
        rngs = (np.random.default_rng([seed, 1]) for seed in range(draws))
        results[:, 1] = np.abs(results[:, 1] + [robot.displacements(len(time), dt, rng) for rng in rngs])
    lateral, along = (tube(rows, dt, cause=cause).scaled(MODEL_ERROR) for rows in results.swapaxes(0, 1))
    return PredictedError(
        reference.name,
        LEVEL,
        f"{draws} drives simulated on {plant.rpartition('/')[2] or plant}",
        time,
        sample.arc_length,
        sample.pose,
        sample.twist,
        lateral,
        along,
    )


def check_count(logs: Sequence[Path]) -> None:
    """Raise ConfigError if there are recorded drives, but too few for a conformal quantile of the level."""
    if 0 < len(logs) < (required := round(LEVEL / (1.0 - LEVEL))):
        raise ConfigError(f"{len(logs)} recorded drives: {100 * LEVEL:g} % needs {required}; record more drives")


def scale_by_logs(
    logs: Sequence[Path], predicted: PredictedError, config: ControllerConfig, plant: str, draws: int, jobs: int
) -> PredictedError:
    """Scale the tubes of a prediction by conformal quantiles of recorded drives.

    The score of a drive is the maximum ratio of its error to the predicted tube of its own path.

    Parameters
    ----------
    logs
        MCAP logs, each of a whole drive on any path; the errors are those of the recorded estimate.

    Raises
    ------
    ConfigError
        If a log is not readable or has no reference, or there are too few logs for the level.
    """
    check_count(logs)
    scores, metres, predictions = [], 0.0, dict[bytes, PredictedError]()
    for log in logs:
        columns = read_drive_log(log).columns
        if (reference := logged_reference(columns, log.name, config)) is None:
            raise ConfigError(f"{log}: the log has no reference; record a drive along a path")
        path = columns["reference_x_m"].tobytes() + columns["reference_y_m"].tobytes()
        tubes = predictions[path] = predictions.get(path) or predict_reference(reference, config, plant, draws, jobs)
        time, metres = columns["t_s"] - columns["t_s"][0], metres + float(tubes.arc_length[-1])
        widths = [np.interp(time, tubes.time, tube.everywhere) for tube in (tubes.lateral, tubes.along)]
        scores.append(np.nanmax(np.abs([columns[f"error_{name}_m"] for name in ("across", "along")]) / widths, axis=1))
    lateral, along = (conformal_quantile([row[None] for row in rows], LEVEL) for rows in np.transpose(scores))
    factors = f"scaled by {len(logs)} recorded drives of {metres:.0f} m, lateral {lateral:.2f}, along {along:.2f} times"
    predicted = replace(predicted, lateral=predicted.lateral.scaled(lateral), along=predicted.along.scaled(along))
    return replace(predicted, drives=f"{predicted.drives}, {factors}")


def _drive(
    reference: Reference, config: ControllerConfig, plant: str, seed: int, count: int
) -> tuple[Sequence[FloatArray], list[str]]:
    """Return the absolute errors of a drive and, if it does not arrive, its two most frequent messages."""
    robot = make_plant(plant, seed=seed, **plant_settings(config))
    run = simulate(Controller(config), robot, reference, lean=True)
    messages = [] if run.metrics.completed else [part for message in run.messages for part in message.split("; ")]
    return absolute_errors(run, count), _most_frequent(filter(None, messages))


def _most_frequent(messages: Iterable[str]) -> list[str]:
    return [message for message, _ in Counter(messages).most_common(2)]
