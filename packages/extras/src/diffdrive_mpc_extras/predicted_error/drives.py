"""Tubes from simulated drives of the robot itself: draws of its model, its unexplained motion and its sensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
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
from diffdrive_mpc_extras.campaign.rates import conformal_quantile
from diffdrive_mpc_extras.predicted_error.predicted_error import ErrorTube, PredictedError
from diffdrive_mpc_extras.replay.reference import logged_reference

MODEL_ERROR = 1.1
"""Factor by which a tube is wider than simulated drives need: the plant has the structure of the model.

Chosen on mujoco:hauler, mujoco:long_naive and eight robots of foreign physics; a drive needed at most 1.12.
"""
DRAWS = 60
"""Drives of a prediction; the tube everywhere needs at least level / (1 - level) of them."""
LEVEL = 0.95
_WINDOW = 1.0
"""Time over which errors of all drives are averaged for the shape of a tube [s]."""
_EVEN = 0.5
"""Share of the mean error of the whole path in the width of each place: a tube never closes on a straight."""


def drive_case(config: str, trajectory: str, plant: str, seed: int) -> Case:
    """Return one drive of the prediction."""
    shipped = is_shipped(config)
    model, file = (config, None) if shipped else (load_config(config).model, config)
    return Case(model=model, config=file, trajectory=trajectory, plant=plant, seed=seed)


def absolute_errors(run: Run, count: int) -> tuple[FloatArray, FloatArray]:
    """Return |lateral| and |along| (count,) [m] at the samples of the reference, infinite after an early end."""
    along, _ = ahead_and_left(run.true_pose - run.reference_pose, run.reference_pose[:, 2])
    lateral, ahead = np.full((2, count), np.inf)
    driven = min(count, len(run.time)) if run.metrics.completed else 0
    for errors, values in ((lateral, run.errors.lateral), (ahead, along)):
        errors[:driven] = np.abs(values[:driven])
        # A run that reaches its goal early stays there.
        errors[driven:] = errors[driven - 1] if driven else np.inf
    return lateral, ahead


def tube(errors: FloatArray, dt: float, level: float = LEVEL) -> ErrorTube:
    """Return the tube of drives like those of `errors` (m, n) [m], samples `dt` [s] apart.

    The width is a multiple of the root mean square over drives and neighbouring places. Each drive is compared with the
    width that the other drives give (jackknife), and the multiples are conformal quantiles of these ratios.

    Raises ConfigError if too few drives arrive for the level.
    """
    arrived = errors[np.isfinite(errors).all(axis=1)]
    squares = uniform_filter1d(arrived**2, max(1, round(_WINDOW / dt)), axis=1, mode="nearest")
    total = squares.sum(axis=0)

    def width(sums: FloatArray, count: int) -> FloatArray:
        local = np.sqrt(sums / count)
        return np.asarray((1.0 - _EVEN) * local + _EVEN * local.mean())

    others = max(1, len(arrived) - 1)
    ratios = [row / width(total - square, others) for row, square in zip(arrived, squares, strict=True)]
    ratios += [np.full(errors.shape[1], np.inf)] * (len(errors) - len(arrived))
    everywhere = conformal_quantile([ratio.max(keepdims=True) for ratio in ratios], level)
    if not np.isfinite(everywhere):
        raise ConfigError(
            f"{len(arrived)} of {len(errors)} simulated drives arrive: too few for {100 * level:g} %; drive slower, or "
            "give more --draws"
        )
    whole = width(total, len(arrived))
    return ErrorTube(conformal_quantile(ratios, level) * whole, everywhere * whole, {})


def predict_by_drives(
    config: str,
    trajectory: str,
    plant: str,
    draws: int = DRAWS,
    jobs: int = 1,
    on_done: Callable[[], None] = lambda: None,
) -> PredictedError:
    """Predict the tracking error of a trajectory from simulated drives on the plant of the robot.

    Parameters
    ----------
    config, trajectory, plant
        As for `simulate`.
    draws
        Number of drives, with the seeds from 0. Their tube is widened by `MODEL_ERROR`.
    jobs
        Processes.
    on_done
        Called after each drive.

    Raises
    ------
    ConfigError, ValueError
        If a name is unknown, a file has a mistake, or too few drives arrive.
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
    """Predict the tracking error of a reference with a configuration, as `predict_by_drives`; raises as that."""
    dt = config.sample_time
    time = np.asarray(np.arange(max(2, int(reference.duration / dt) + 1)) * dt, dtype=np.float64)
    tasks = [partial(_driven, reference, config, plant, seed, len(time)) for seed in range(draws)]
    driven = run_tasks(tasks, jobs, on_done)
    lateral, along = (tube(np.array(errors), dt).times(MODEL_ERROR) for errors in zip(*driven, strict=True))
    sample = reference.sample(time)
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


def learn_from(
    logs: Sequence[Path], predicted: PredictedError, config: ControllerConfig, plant: str, draws: int, jobs: int
) -> PredictedError:
    """Scale the tubes of a prediction so that recorded drives stay inside theirs all the way, by conformal quantiles.

    Parameters
    ----------
    logs
        MCAP logs of whole drives, one each, on any paths. Their errors are those of the recorded estimate.

    Raises
    ------
    ConfigError
        If a log cannot be read or has no reference, or there are too few for the level.
    """
    scores, metres, known = [], 0.0, dict[bytes, PredictedError]()
    for log in logs:
        columns = read_drive_log(log).columns
        if (reference := logged_reference(columns, log.name, config)) is None:
            raise ConfigError(f"{log}: there is no reference in it; record a drive along a path")
        path = columns["reference_x_m"].tobytes() + columns["reference_y_m"].tobytes()
        tubes = known[path] = known.get(path) or predict_reference(reference, config, plant, draws, jobs)
        time, metres = columns["t_s"] - columns["t_s"][0], metres + float(tubes.arc_length[-1])
        widths = [np.interp(time, tubes.time, tube.everywhere) for tube in (tubes.lateral, tubes.along)]
        scores.append(np.nanmax(np.abs([columns[f"error_{name}_m"] for name in ("across", "along")]) / widths, axis=1))
    lateral, along = (conformal_quantile([row[None] for row in rows], LEVEL) for rows in np.transpose(scores))
    if not np.isfinite([lateral, along]).all():
        least = f"{100 * LEVEL:g} % needs {LEVEL / (1.0 - LEVEL):.0f}"
        raise ConfigError(f"{len(logs)} recorded drives: {least}; record more")
    learned = f"scaled by {len(logs)} recorded drives of {metres:.0f} m, lateral {lateral:.2f}, along {along:.2f} times"
    predicted = replace(predicted, lateral=predicted.lateral.times(lateral), along=predicted.along.times(along))
    return replace(predicted, drives=f"{predicted.drives}, {learned}")


def _driven(reference: Reference, config: ControllerConfig, plant: str, seed: int, count: int) -> Sequence[FloatArray]:
    robot = make_plant(plant, seed=seed, **plant_settings(config))
    return absolute_errors(simulate(Controller(config), robot, reference, lean=True), count)
