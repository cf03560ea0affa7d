"""Search with Optuna over runs of `diffdrive_mpc.sweep`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.sweep import sweep
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.errors import MissingPackageError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.load import is_shipped, load_model
from diffdrive_mpc.mpc import ControllerConfig, load_config
from diffdrive_mpc.mpc.config.rooms import plain_key
from diffdrive_mpc.mpc.problem.build import build_problem, chosen_model
from diffdrive_mpc.mpc.trajectories.moved import scaled_to_robot
from diffdrive_mpc_extras.tuning.tune_file import TunePlan

if TYPE_CHECKING:
    from pandas import DataFrame

Values = dict[str, float | int]
_DIGITS = 4


@dataclass(frozen=True)
class TunePoint:
    """Configuration that the search evaluated.

    Attributes
    ----------
    number
        Position in the search; 0 is the start configuration.
    values
        Value of each parameter.
    error
        Mean position RMSE over the runs of the tuning seeds, failures included [m].
    failures
        Number of failed_runs runs.
    """

    number: int
    values: Values
    error: float
    failures: int


class ConfigurationSearch:
    """Search of a plan from one start configuration.

    Parameters
    ----------
    config
        Name of a shipped configuration or path of a file.
    plan
        Ranges, runs and seeds.

    Attributes
    ----------
    start
        Values of the tuned keys in the start configuration.
    skipped
        Keys of the plan that are not tuned, because their values have two sides.

    Raises ConfigError if a key or a range is invalid, MissingPackageError without Optuna.
    """

    def __init__(self, config: str, plan: TunePlan) -> None:
        self._optuna = import_optuna()
        self._plan = plan
        start = load_config(config)
        self._config_options = {"model": config} if is_shipped(config) else {"config": config, "model": start.model}
        complete_config = build_problem(start, chosen_model(start, None)).config
        values = {key: _value(complete_config, key) for key in plan.parameters}
        self._runs: dict[str, Any] = {str(name): texts for name, texts in plan.runs.items()}
        self.skipped: list[str] = []
        if plan.adapt_to_robot and not is_shipped(config):
            self.skipped = [key for key, value in values.items() if isinstance(value, Mapping)]
            model, paths = load_model(start.model), self._runs.get("trajectory", ())
            names = (paths,) if isinstance(paths, str) else paths
            self._runs["trajectory"] = [scaled_to_robot(name, start, model) for name in names]
        self.start: Values = {key: value for key, value in values.items() if key not in self.skipped}
        bounds = {key: plan.parameters[key].bounds(key, value) for key, value in self.start.items()}
        for side in range(2):
            load_config(config, {key: type(self.start[key])(pair[side]) for key, pair in bounds.items()})
        self._distributions = {key: self._distribution(key, *pair) for key, pair in bounds.items()}

    def drive(self, values: Mapping[str, Any], seeds: Iterable[int], jobs: int, bar: ProgressBar) -> DataFrame:
        """Run every combination of the plan and the seeds with `values`; return the table of `sweep`."""
        changes = {key: value for key, value in values.items() if value != self.start[key]}
        items = [*self._config_options.items(), *self._runs.items(), *changes.items()]
        options: dict[str, Any] = {str(name): value for name, value in items}
        return sweep(seeds=seeds, jobs=jobs, on_done=bar.advance, **options)

    def run(self, jobs: int, bar: ProgressBar) -> list[TunePoint]:
        """Evaluate the start configuration, then the points that Optuna proposes; return all points in order."""
        plan, points = self._plan, list[TunePoint]()
        sampler = self._optuna.samplers.TPESampler(seed=plan.sampler_seed)
        study = self._optuna.create_study(sampler=sampler)
        study.enqueue_trial(self.start)
        for number in range(plan.points):
            best = f", best {1e3 * best_of(points).error:.3g} mm" if points else ""
            runs = plan.combinations * plan.tuning_seeds.count
            bar.start_stage(f"point {number + 1} of {plan.points}{best}", runs)
            trial = study.ask(self._distributions)
            values = {key: self._round(key, value) for key, value in trial.params.items()}
            rows = self.drive(values, plan.tuning_seeds.seeds, jobs, bar)
            point = TunePoint(number, values, float(self.errors(rows).mean()), int(failed_runs(rows).sum()))
            study.tell(trial, point.error)
            points.append(point)
        return points

    def errors(self, rows: DataFrame) -> FloatArray:
        """Compute the position RMSE of each run [m]; a failed_runs run counts with at least `failure_error`."""
        measured = rows["position_rmse_m"].to_numpy(dtype=float)
        return np.asarray(np.where(failed_runs(rows), np.fmax(measured, self._plan.failure_error), measured))

    def _round(self, key: str, value: float) -> float | int:
        is_exact = isinstance(value, int) or value == self.start[key]
        return value if is_exact else float(f"{value:.{_DIGITS}g}")

    def _distribution(self, key: str, low: float, high: float) -> Any:  # noqa: ANN401 - untyped
        search_range, distributions = self._plan.parameters[key], self._optuna.distributions
        is_log = search_range.log or search_range.times is not None
        if isinstance(self.start[key], int):
            return distributions.IntDistribution(math.ceil(low), math.floor(high), log=is_log)
        return distributions.FloatDistribution(low, high, log=is_log)


def best_of(points: Iterable[TunePoint]) -> TunePoint:
    """Return the point with the minimum error; of equal points the first."""
    return min(points, key=lambda point: (point.error, point.number))


def failed_runs(rows: DataFrame) -> FloatArray:
    """Return booleans (runs,): True if a run ended early or did not complete its path."""
    return np.asarray(~rows["completed"].to_numpy(dtype=bool) | (rows["ended"].to_numpy(dtype=str) != ""))


def _value(config: ControllerConfig, key: str) -> Any:  # noqa: ANN401 - any value of a configuration
    value: Any = config.model_dump()
    for name in plain_key(key).split("."):
        if not isinstance(value, Mapping) or name not in value:
            raise ConfigError(f"parameters.{key}: the configuration has no such key; see diffdrive-mpc config schema")
        value = value[name]
    return value


def import_optuna() -> Any:  # noqa: ANN401 - a module
    """Import Optuna without its progress messages; raises MissingPackageError if it is not installed."""
    try:
        import optuna  # noqa: PLC0415 - optional
    except ImportError as error:
        raise MissingPackageError("tune needs Optuna: pip install 'diffdrive-mpc-extras[tune]'") from error
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return optuna
