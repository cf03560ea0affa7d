"""The study of Optuna behind a search: its storage, its sampler, and what is kept with each point."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.app.tune.tune_file import SearchRange
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.errors import MissingPackageError
from diffdrive_mpc.models.whole_file import reason
from diffdrive_mpc_extras.campaign.draws import Value

JOURNAL = "study.journal"
STARTUP = 16
"""Points that are drawn without looking at others, the defaults included."""


def needs_optuna() -> Any:  # noqa: ANN401 - a module
    """Give Optuna, which says nothing but errors; raises MissingPackageError where it is not installed."""
    try:
        import optuna  # noqa: PLC0415 - optional
    except ImportError as error:
        raise MissingPackageError("tune needs Optuna: pip install diffdrive-mpc[tune]") from error
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    return optuna


def open_study(name: str, folder: Path, storage: str, keep: int) -> Any:  # noqa: ANN401 - a study
    """The study of that name, which is made where missing.

    Parameters
    ----------
    name
        Of the study.
    folder
        Where a journal file is its storage; on a shared folder several machines may write to it.
    storage
        Address of a data base in its place, such as "mysql://..."; empty for the file.
    keep
        One of so many points goes on to the next fidelity (successive halving, asynchronous: Li et al., MLSys 2020).

    Raises ConfigError if the storage cannot be used, MissingPackageError without Optuna.
    """
    optuna = needs_optuna()
    pruner = optuna.pruners.SuccessiveHalvingPruner(min_resource=1, reduction_factor=keep)
    try:
        backend = storage or optuna.storages.JournalStorage(
            optuna.storages.journal.JournalFileBackend(str(folder / JOURNAL))
        )
        return optuna.create_study(study_name=name, storage=backend, pruner=pruner, load_if_exists=True)
    except OSError as error:
        raise ConfigError(f"--out {folder}: cannot be written to ({reason(error)}); give a folder") from error
    except Exception as error:
        if not storage:
            raise
        raise ConfigError(f"--storage {storage}: {' '.join(str(error).split())}") from error


def sampler(*seeds: int) -> Any:  # noqa: ANN401 - a sampler
    """A tree-structured Parzen estimator (Bergstra et al., NeurIPS 2011) whose random numbers come from these seeds."""
    seed = np.random.SeedSequence(seeds).generate_state(1)
    return needs_optuna().samplers.TPESampler(seed=int(seed[0]), n_startup_trials=STARTUP, constant_liar=True)


def distribution(key: str, of: SearchRange, now: Value) -> Any:  # noqa: ANN401 - a distribution
    """What Optuna draws from for a parameter; raises ConfigError where `now`, its value, is none or lies outside."""
    if isinstance(now, bool) or not isinstance(now, (int, float)):
        raise ConfigError(f"parameters.{key}: its value is {now!r}; only numbers are tuned, leave it out")
    if of.times is not None and not now > 0:
        raise ConfigError(f"parameters.{key}: its value is {now:g}, a factor on it is nothing; give low and high")
    low, high = (now * time for time in of.times) if of.times is not None else (float(of.low or 0), float(of.high or 0))
    if not low <= now <= high:
        raise ConfigError(
            f"parameters.{key}: the configuration has {now:g}, which is not between {low:g} and {high:g}; widen it"
        )
    distributions = needs_optuna().distributions
    log = of.log or of.times is not None
    if isinstance(now, int):
        return distributions.IntDistribution(round(low), round(high), log=log)
    return distributions.FloatDistribution(low, high, log=log)


def near(distributions: Mapping[str, Any], now: Mapping[str, Any], *seeds: int) -> dict[str, Value]:
    """A first point: half way between the defaults, which are no bad ones, and a point anywhere in the ranges."""
    shares = np.random.default_rng(np.random.SeedSequence(seeds)).random(len(distributions))
    params: dict[str, Value] = {}
    for (key, one), share in zip(distributions.items(), shares, strict=True):
        low, high, here = (math.log(end) if one.log else end for end in (one.low, one.high, now[key]))
        there = 0.5 * (here + low + share * (high - low))
        value = min(max(math.exp(there) if one.log else there, one.low), one.high)
        params[key] = round(value) if isinstance(one.low, int) else float(value)
    return params


def values_of(params: Mapping[str, Value], now: Mapping[str, Value], digits: int = 4) -> dict[str, Value]:
    """Values as a configuration gets them: rounded, but those of the defaults."""
    return {
        key: value if value == now[key] or isinstance(value, int) else float(f"{value:.{digits}g}")
        for key, value in params.items()
    }
