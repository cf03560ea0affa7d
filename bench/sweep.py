"""Sweep over all combinations of models, trajectories, seeds and configuration values."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_mpc.bench.case import DIMENSIONS, MAX_SEEDS, Case, Overrides, check_count, check_different
from diffdrive_mpc.bench.controllers import build_plant, case_config, check_cases, load_reference, make_controller
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.run_row import statistics_of
from diffdrive_mpc.bench.runner import OnDone, available_cores, run_tasks
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.errors import checked_call, load_pandas, wrong_type
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc import Controller, Trajectory
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.config.typed_settings import parse_settings
from diffdrive_mpc.sim.loop import simulate

if TYPE_CHECKING:
    from pandas import DataFrame


def sweep_settings(texts: Sequence[str]) -> list[Overrides]:
    """Parse settings and return every combination of their values, in order; no settings have one empty combination.

    Raise the errors of `parse_settings`, and ValueError if there are too many combinations.
    """
    parsed = parse_settings(texts)
    check_count(math.prod(len(values) for _, values in parsed))
    keys = [key for key, _ in parsed]
    return [tuple(zip(keys, combination, strict=True)) for combination in itertools.product(*(v for _, v in parsed))]


# `diffdrive_mpc.sweep`: table of all combinations of models, trajectories, seeds and configuration values.


Model = VelocityModel | NonlinearModel
_DEFAULTS = {dimension.name: dimension.default for dimension in DIMENSIONS}
_OBJECTS = {
    "model": ((VelocityModel, NonlinearModel), "VelocityModel.from_control(system)"),
    "trajectory": ((Trajectory,), "Trajectory.from_arrays(t, x, y)"),
}
"""Classes of the objects that a dimension accepts in addition to names, and the call that creates one."""


@checked_call()
def sweep(
    *,
    model: str | Path | Model | Iterable[str | Path | Model] = "ssm",
    trajectory: str | Path | Trajectory | Iterable[str | Path | Trajectory] = "circle",
    seeds: int | Iterable[int] = 1,
    plant: str | Iterable[str] = "mujoco",
    config: str | Path | None = None,
    jobs: int | None = None,
    on_done: OnDone | None = None,
    **values: Any,  # noqa: ANN401 - any value of a configuration
) -> DataFrame:
    """Run every combination of the values and return a pandas table with one row per run.

    Example: `sweep(model=["sm", "ssm"], trajectory=["circle", "s"], seeds=range(5), **{"horizon": [10, 30]})`.

    Parameters
    ----------
    model
        Models, or names or paths of models; see `load_model`.
    trajectory
        Trajectories, or names or paths of trajectories; see `load_trajectory`.
    seeds
        Seeds of the noise, or the number of seeds; a number n stands for the seeds 0 to n - 1.
    plant
        Names of plants; see `make_plant`.
    config
        Configuration file; by default the built-in configuration of each model. The default of a user's model is the
        built-in configuration of the SSM without its extra dead time.
    jobs
        Number of processes; by default the number of cores. The table contains step times only if `jobs=1`, because
        parallel runs disturb each other.
    on_done
        Function that is called after each run; if given, there is no progress bar.
    values
        One or several values of a dimension of the bench (`surface`, `sensors`, `scenario`, `timing`, `controller`) or
        of a configuration value by dotted key, such as `**{"weights.across": [100, 300]}`.

    Returns
    -------
    pandas.DataFrame
        Dimensions, configuration values, statistics of `Run.metrics`, and `ended`, which is empty if the run was not
        aborted. Example of a plot: `table.pivot_table("position_rmse_m", "horizon", "model").plot()`.

    Raises
    ------
    ArgumentError, ConfigError, ModelError, ValueError
        If a name or key is unknown or a value is invalid; no case is run.
    MissingPackageError
        If pandas is not installed.
    """
    pandas = load_pandas("sweep")
    if not isinstance(config, (str, Path, type(None))):
        remedy = "for objects, use drive_many of diffdrive-mpc-extras"
        raise wrong_type("sweep: config", "a name or path", config, remedy)
    factors = {
        "model": as_list(model),
        "trajectory": as_list(trajectory),
        "seed": _seeds(seeds),
        "plant": as_list(plant),
    }
    factors |= {name: as_list(value) for name, value in values.items()}
    for name, options in factors.items():
        similar = get_close_matches(name, [*_DEFAULTS, "seeds"], 1, 0.8)
        if similar and name not in _DEFAULTS and name not in ControllerConfig.model_fields:
            raise ConfigError(f"sweep: unknown argument '{name}'; did you mean '{similar[0]}'?")
        if name in _DEFAULTS and name != "seed":
            _check_kinds(name, options)
        check_different(f"sweep: {name}", options)
        if name not in _DEFAULTS and any(isinstance(value, (Mapping, list, tuple)) for value in options):
            raise ConfigError(
                f"sweep: {name}: use numbers or words; the values of a group have dotted keys, such as 'weights.across'"
            )
    check_count(math.prod(map(len, factors.values())))
    rows = [dict(zip(factors, combination, strict=True)) for combination in itertools.product(*factors.values())]
    tasks = [_Task(row, None if config is None else str(config)) for row in rows]
    for has_reference in (False, True):
        selected = (task.case for task in tasks if task.has_reference == has_reference)
        check_cases(selected, has_references=has_reference)
    jobs = available_cores() if jobs is None else jobs
    calls = [partial(task.row, timed=jobs == 1) for task in tasks]
    if on_done is not None:
        return pandas.DataFrame(run_tasks(calls, jobs, on_done))
    with ProgressBar("sweep", len(tasks), lines=True) as bar:
        return pandas.DataFrame(run_tasks(calls, jobs, bar.advance))


class _Task:
    """Run of a case, and the objects that replace its model and trajectory."""

    def __init__(self, values: Mapping[str, Any], config: str | None) -> None:
        self._values = values
        self._model = values["model"] if isinstance(values["model"], Model) else None
        self._trajectory = values["trajectory"] if isinstance(values["trajectory"], Trajectory) else None
        dimensions = {name: value for name, value in values.items() if name in _DEFAULTS}
        for name, replacement in (("model", self._model), ("trajectory", self._trajectory)):
            dimensions[name] = _DEFAULTS[name] if replacement is not None else str(values[name])
        overrides = tuple((name, value) for name, value in values.items() if name not in _DEFAULTS)
        self.case = Case(**dimensions, config=config, overrides=overrides)
        self.has_reference = self._trajectory is not None

    def row(self, *, timed: bool) -> dict[str, object]:
        """Run the case and return its row."""
        case = self.case
        controller = make_controller(case) if self._model is None else Controller(case_config(case), self._model)
        reference = load_reference(case) if self._trajectory is None else self._trajectory
        run = simulate(controller, build_plant(case), reference)
        objects = (VelocityModel, NonlinearModel, Trajectory)
        values = {name: value.name if isinstance(value, objects) else value for name, value in self._values.items()}
        return {**values, **statistics_of(run, timed=timed), "ended": run.ended}


def as_list(value: Any) -> list[Any]:  # noqa: ANN401
    """Return one or several values as a list."""
    single = (str, Path, Mapping, ControllerConfig)
    return [value] if isinstance(value, single) or not isinstance(value, Iterable) else list(value)


def _seeds(seeds: Any) -> list[int]:  # noqa: ANN401
    """Return `seeds` as a list; a number n stands for the seeds 0 to n - 1."""
    if isinstance(seeds, int) and not 1 <= seeds <= MAX_SEEDS:
        raise ConfigError(f"sweep: seeds = {seeds}; use 1 to {MAX_SEEDS}, or a list such as [3, 4]")
    seed_list = list(range(seeds)) if isinstance(seeds, int) else as_list(seeds)
    if not all(isinstance(seed, (int, np.integer)) and seed >= 0 for seed in seed_list):
        raise ConfigError(f"sweep: seeds {seeds!r}; use integers of at least 0, or the number of seeds")
    return [int(seed) for seed in seed_list]


def _check_kinds(name: str, options: Sequence[object]) -> None:
    """Raise ArgumentError for a value of a dimension that is neither a name nor a supported object."""
    kinds, call = _OBJECTS.get(name, ((), ""))
    for value in options:
        if not isinstance(value, (str, Path, *kinds)):
            expected = f"a name, a path or a {name}" if kinds else "a name"
            remedy = f"create it with {call}" if kinds else f"give a name such as '{_DEFAULTS[name]}'"
            raise wrong_type(f"sweep: {name}", expected, value, remedy)
