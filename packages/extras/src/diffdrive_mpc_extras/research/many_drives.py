"""`drive_many`: closed-loop drives of several configurations in a process pool, as a table."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diffdrive_mpc.bench.case import check_count
from diffdrive_mpc.bench.drive import plant_settings
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.run_row import statistics_of
from diffdrive_mpc.bench.runner import OnDone, available_cores, run_tasks
from diffdrive_mpc.models.errors import checked_call, load_pandas, wrong_type
from diffdrive_mpc.mpc import Controller, ControllerConfig, Trajectory, load_config, load_trajectory
from diffdrive_mpc.sim import make_plant, simulate

if TYPE_CHECKING:
    from pandas import DataFrame

Config = str | Path | ControllerConfig


@checked_call()
def drive_many(
    configs: Mapping[str, Config] | Iterable[Config] | Config = "ssm",
    trajectories: Iterable[str | Path | Trajectory] | str | Path | Trajectory = "circle",
    seeds: Iterable[int] = range(5),
    *,
    plant: str = "mujoco",
    jobs: int | None = None,
    on_done: OnDone | None = None,
) -> DataFrame:
    """Drive every configuration along every trajectory with every seed, and return a table with one row per drive.

    Parameters
    ----------
    configs
        Configurations by the names that they have in the table; or configurations, names or paths, which are named as
        they were given, objects by their number.
    trajectories
        Trajectories, or names or paths, which are loaded with the limits of each configuration.
    seeds
        Seeds of the noise.
    plant
        As `make_plant` takes it; it gets sample time and limits of each configuration.
    jobs
        Processes; by default one for each core. The table does not depend on it.
    on_done
        Function to call after each drive, in place of a progress bar.

    Returns
    -------
    pandas.DataFrame
        Columns `config`, `trajectory`, `seed`, the statistics of `Run.metrics` but times of steps, and `ended`: the
        reason of a premature end, or an empty text.

    Raises
    ------
    ConfigError, ModelError, ValueError
        If a name is unknown or a file has a mistake; nothing is driven then.
    MissingPackageError
        If pandas is not installed.
    ArgumentError
        If `seeds` is a number.
    """
    pandas = load_pandas("drive_many")
    if not hasattr(seeds, "__iter__"):
        raise wrong_type("seeds", "several seeds", seeds, "give range(5), or a list")
    named = (
        dict(configs)
        if isinstance(configs, Mapping)
        else {_name(number, config): config for number, config in enumerate(_each(configs))}
    )
    loaded = {name: load_config(config) for name, config in named.items()}
    drawn = [int(seed) for seed in seeds]
    paths = _each(trajectories)
    check_count(len(loaded) * len(paths) * len(drawn))
    tasks = []
    for (name, config), path in itertools.product(loaded.items(), paths):
        reference = path if isinstance(path, Trajectory) else load_trajectory(path, config)
        make_plant(plant, **plant_settings(config))
        tasks += [partial(_drive, name, config, reference, plant, seed) for seed in drawn]
    jobs = jobs or available_cores()
    if on_done is not None:
        return pandas.DataFrame(run_tasks(tasks, jobs, on_done))
    with ProgressBar("drives", len(tasks), lines=True) as bar:
        return pandas.DataFrame(run_tasks(tasks, jobs, bar.advance))


def _drive(name: str, config: ControllerConfig, reference: Trajectory, plant: str, seed: int) -> dict[str, object]:
    """Drive once and return the row."""
    run = simulate(Controller(config), make_plant(plant, seed=seed, **plant_settings(config)), reference, lean=True)
    place = {"config": name, "trajectory": reference.name, "seed": seed}
    return {**place, **statistics_of(run, timed=False), "ended": run.ended}


def _each(values: Any) -> list[Any]:  # noqa: ANN401 - one value or several
    return [values] if isinstance(values, (str, Path, ControllerConfig, Trajectory)) else list(values)


def _name(number: int, config: Config) -> str:
    return str(number) if isinstance(config, ControllerConfig) else Path(config).stem
