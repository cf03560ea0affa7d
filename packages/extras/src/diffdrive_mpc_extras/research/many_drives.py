"""`drive_many`: closed-loop drives of several configurations in a process pool, as a table."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from diffdrive_mpc.bench.case import check_count, check_different
from diffdrive_mpc.bench.drive import plant_settings
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.run_row import statistics_of
from diffdrive_mpc.bench.runner import OnDone, available_cores, run_tasks
from diffdrive_mpc.bench.sweep import as_list
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
    """Simulate every combination of configuration, trajectory and seed; return a table with one row per drive.

    Parameters
    ----------
    configs
        Configurations by their names in the table; or configurations, names or paths, with the name of the file or the
        index of an object as name in the table.
    trajectories
        Trajectories, or names or paths, which are loaded with the limits of each configuration.
    seeds
        Seeds of the noise.
    plant
        Plant, as for `make_plant`, with the sample time and limits of each configuration.
    jobs
        Number of processes, by default one per core. The table does not depend on it.
    on_done
        Callback after each drive, instead of a progress bar.

    Returns
    -------
    pandas.DataFrame
        Columns `config`, `trajectory`, `seed`, the statistics of `Run.metrics` without computing times, and `ended`:
        the reason for an early end, or an empty text.

    Raises
    ------
    ConfigError, ModelError, ValueError
        If a name is unknown or a file is invalid; no drive is simulated then.
    MissingPackageError
        If pandas is not installed.
    ArgumentError
        If `seeds` is a number.
    """
    pandas = load_pandas("drive_many")
    if not hasattr(seeds, "__iter__"):
        raise wrong_type("seeds", "several seeds", seeds, "give range(5), or a list")
    if isinstance(configs, Mapping):
        named = list(configs.items())
    else:
        named = [(_name(index, config), config) for index, config in enumerate(as_list(configs))]
    drawn, paths = list(seeds), as_list(trajectories)
    loaded = [(name, load_config(config)) for name, config in named]
    if not drawn or any(seed != int(seed) for seed in drawn):
        raise wrong_type("seeds", "at least one whole number", drawn, "give range(5), or a list")
    seeds = [int(seed) for seed in drawn]
    check_count(len(loaded) * len(paths) * len(seeds))
    tasks = []
    for (name, config), path in itertools.product(loaded, paths):
        reference = path if isinstance(path, Trajectory) else load_trajectory(path, config)
        make_plant(plant, **plant_settings(config))
        tasks += [partial(_drive, name, config, reference, plant, seed) for seed in seeds]
    for name, values in {"configs": [name for name, _ in named], "trajectories": paths, "seeds": seeds}.items():
        check_different(f"drive_many: {name}", values)
    jobs = available_cores() if jobs is None else jobs
    if on_done is not None:
        return pandas.DataFrame(run_tasks(tasks, jobs, on_done))
    with ProgressBar("drives", len(tasks), lines=True) as bar:
        return pandas.DataFrame(run_tasks(tasks, jobs, bar.advance))


def _drive(name: str, config: ControllerConfig, reference: Trajectory, plant: str, seed: int) -> dict[str, object]:
    """Simulate one drive and return its row."""
    run = simulate(Controller(config), make_plant(plant, seed=seed, **plant_settings(config)), reference, lean=True)
    key = {"config": name, "trajectory": reference.name, "seed": seed}
    return {**key, **statistics_of(run, timed=False), "ended": run.ended}


def _name(index: int, config: Config) -> str:
    return Path(config).stem if isinstance(config, (str, Path)) else str(index)
