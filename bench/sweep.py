"""Run every combination of models, trajectories, seeds and configuration values."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_mpc.bench.case import DIMENSIONS, MAX_SEEDS, Case, Overrides, check_count
from diffdrive_mpc.bench.controllers import build_plant, case_config, check_cases, load_reference, make_controller
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.run_row import statistics_of
from diffdrive_mpc.bench.runner import OnDone, available_cores, run_tasks
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.errors import load_pandas, wrong_type
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc import Controller, Trajectory
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.config.typed_settings import parsed_settings
from diffdrive_mpc.sim.loop import simulate

if TYPE_CHECKING:
    from pandas import DataFrame


def sweep_settings(texts: Sequence[str]) -> list[Overrides]:
    """Return every combination of the values of several settings, in order; one empty combination without any.

    Raises ConfigError as for `parsed_settings`, and if there are too many combinations.
    """
    parsed = parsed_settings(texts)
    check_count(math.prod(len(values) for _, values in parsed))
    keys = [key for key, _ in parsed]
    return [tuple(zip(keys, combination, strict=True)) for combination in itertools.product(*(v for _, v in parsed))]


# `diffdrive_mpc.sweep`: every combination of models, trajectories, seeds and configuration values, as a table.


Model = VelocityModel | NonlinearModel
_DEFAULTS = {dimension.name: dimension.default for dimension in DIMENSIONS}


def sweep(
    *,
    model: str | Path | Model | Iterable[str | Path | Model] = "ssm",
    trajectory: str | Path | Trajectory | Iterable[str | Path | Trajectory] = "circle",
    seeds: int | Iterable[int] = 1,
    plant: str | Iterable[str] = "mujoco",
    config: str | Path | None = None,
    jobs: int | None = None,
    on_done: OnDone | None = None,
    **values: Any,  # noqa: ANN401 - as the configuration takes them
) -> DataFrame:
    """Run every combination of the values, and give a pandas table with one row a run.

    An example: `sweep(model=["sm", "ssm"], trajectory=["circle", "s"], seeds=range(5), **{"horizon": [10, 30]})`.

    Parameters
    ----------
    model
        Names or paths of models as `load_model` takes them, or models.
    trajectory
        Names or paths of trajectories as `load_trajectory` takes them, or trajectories.
    seeds
        Seeds of the noise, or how many of them, from 0 on.
    plant
        Names of plants as `make_plant` takes them.
    config
        Configuration file; by default the shipped one of each model, and for a model of yours that of the SSM without
        its extra dead time.
    jobs
        Processes; by default one for each core. Times of steps are in the table for `jobs=1` alone: runs side by side
        disturb each other.
    on_done
        Function to call after each run, in place of a progress bar.
    values
        By the name of a dimension of the bench (`surface`, `sensors`, `scenario`, `timing`, `controller`), or
        else by the dotted key of a configuration, one value or several: `**{"weights.across": [100, 300]}`.

    Returns
    -------
    pandas.DataFrame
        The dimensions, the configuration values, then the statistics of `Run.metrics` and `ended`, empty where the run
        came to its end. To plot it: `table.pivot_table("position_rmse_m", "horizon", "model").plot()`.

    Raises
    ------
    ArgumentError, ConfigError, ModelError, ValueError
        If a name or key is unknown or a value cannot be used; nothing is run then.
    MissingPackageError
        If pandas is not installed.
    """
    pandas = load_pandas("sweep")
    listed = {
        "model": _listed(model),
        "trajectory": _listed(trajectory),
        "seed": _seeds(seeds),
        "plant": _listed(plant),
    }
    listed |= {name: _listed(value) for name, value in values.items()}
    for name, several in listed.items():
        near = get_close_matches(name, [*_DEFAULTS, "seeds"], 1, 0.8)
        if near and name not in _DEFAULTS and name not in ControllerConfig.model_fields:
            raise ConfigError(f"sweep: unknown argument '{name}'; did you mean '{near[0]}'?")
        if not several:
            raise ConfigError(f"sweep: {name} has no value; give one or several")
        if name not in _DEFAULTS and any(isinstance(value, (Mapping, list, tuple)) for value in several):
            raise ConfigError(
                f"sweep: {name}: give numbers or words; groups have dotted keys, such as 'weights.across'"
            )
    check_count(math.prod(map(len, listed.values())))
    rows = [dict(zip(listed, combination, strict=True)) for combination in itertools.product(*listed.values())]
    tasks = [_Task(row, None if config is None else str(config)) for row in rows]
    check_cases(task.case for task in tasks)
    jobs = jobs or available_cores()
    calls = [partial(task.row, timed=jobs == 1) for task in tasks]
    if on_done is not None:
        return pandas.DataFrame(run_tasks(calls, jobs, on_done))
    with ProgressBar("sweep", len(tasks)) as bar:
        return pandas.DataFrame(run_tasks(calls, jobs, bar.advance))


class _Task:
    """One run: a case, and the objects that stand for its model and trajectory."""

    def __init__(self, values: Mapping[str, Any], config: str | None) -> None:
        self._values = values
        self._model = values["model"] if isinstance(values["model"], Model) else None
        self._trajectory = values["trajectory"] if isinstance(values["trajectory"], Trajectory) else None
        dimensions = {name: value for name, value in values.items() if name in _DEFAULTS}
        for name, replaced in (("model", self._model), ("trajectory", self._trajectory)):
            dimensions[name] = _DEFAULTS[name] if replaced is not None else _named(name, values[name])
        overrides = tuple((name, value) for name, value in values.items() if name not in _DEFAULTS)
        self.case = Case(**dimensions, config=config, overrides=overrides)

    def row(self, *, timed: bool) -> dict[str, object]:
        """Run it, and give its row."""
        case = self.case
        controller = make_controller(case) if self._model is None else Controller(case_config(case), self._model)
        reference = load_reference(case) if self._trajectory is None else self._trajectory
        run = simulate(controller, build_plant(case), reference)
        objects = (VelocityModel, NonlinearModel, Trajectory)
        shown = {name: value.name if isinstance(value, objects) else value for name, value in self._values.items()}
        return {**shown, **statistics_of(run, timed=timed), "ended": run.ended}


def _listed(value: Any) -> list[Any]:  # noqa: ANN401
    """Return one value or several as a list."""
    single = (str, Path, Mapping, VelocityModel, NonlinearModel, Trajectory)
    return [value] if isinstance(value, single) or not isinstance(value, Iterable) else list(value)


def _seeds(seeds: Any) -> list[int]:  # noqa: ANN401
    """Return the given seeds, or the first n seeds."""
    if isinstance(seeds, int) and not 1 <= seeds <= MAX_SEEDS:
        raise ConfigError(f"sweep: seeds = {seeds}; give 1 to {MAX_SEEDS}, or a list such as [3, 4]")
    listed = list(range(seeds)) if isinstance(seeds, int) else _listed(seeds)
    if not all(isinstance(seed, (int, np.integer)) and seed >= 0 for seed in listed):
        raise ConfigError(f"sweep: seeds {seeds!r}; give whole numbers from 0 on, or how many")
    return [int(seed) for seed in listed]


def _named(name: str, value: object) -> str:
    if not isinstance(value, (str, Path)):
        made = "VelocityModel.from_control(system)" if name == "model" else "Trajectory.from_arrays(t, x, y)"
        raise wrong_type(f"sweep: {name}", f"a name, a path or a {name}", value, f"make it with {made}")
    return str(value)
