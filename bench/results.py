"""Outcomes as plain rows and as `bench.json`."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path

from diffdrive_mpc.bench.case import NO_SCENARIO, label
from diffdrive_mpc.bench.controllers import PEERS, controller_config
from diffdrive_mpc.bench.experiment import Experiment
from diffdrive_mpc.bench.machine import describe_run
from diffdrive_mpc.bench.runner import Outcome
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings

TIMING = "serial replay of the recorded measurements, one core, one BLAS thread, garbage collection off, whole step"
STATISTICS = "true pose against the reference, from t = 0 to the end of the reference, no settling time added"


@dataclass(frozen=True)
class Results:
    """What an experiment gave.

    Attributes
    ----------
    experiment
        What was asked for.
    main
        Outcomes of the comparison.
    horizon
        Outcomes of the horizon sweep; they may be among `main` too.
    meta
        Machine, versions and definitions, as in `bench.json`.
    """

    experiment: Experiment
    main: tuple[Outcome, ...]
    horizon: tuple[Outcome, ...]
    meta: dict[str, object]

    @property
    def all(self) -> tuple[Outcome, ...]:
        """Every outcome once, in order."""
        return tuple({outcome.case: outcome for outcome in (*self.main, *self.horizon)}.values())

    def as_json(self) -> dict[str, object]:
        """`{"meta": ..., "runs": [...]}` of plain values; what could not be computed is None."""
        swept, disturbed = any(self.experiment.settings), self.experiment.scenarios != (NO_SCENARIO,)
        runs = [row(outcome, with_settings=swept, with_scenario=disturbed) for outcome in self.all]
        return {"meta": self.meta, "runs": runs}


def row(outcome: Outcome, *, with_settings: bool = False, with_scenario: bool = False) -> dict[str, object]:
    """One run as plain values.

    Parameters
    ----------
    outcome
        The run.
    with_settings
        Add the swept configuration values under "set".
    with_scenario
        Add the scenario's name, why the run ended before its time, begin and end of the disturbance [s] and the
        figures of the recovery from it.
    """
    case = outcome.case
    values: dict[str, object] = {
        "controller": case.labels["controller"],
        "model": case.labels["model"],
        "trajectory": case.labels["trajectory"],
        "plant": case.labels["plant"],
        "surface": case.labels["surface"],
        "sensors": case.labels["sensors"],
        "seed": case.seed,
        "horizon": case.horizon,
    }
    values |= {name: _plain(value) for name, value in asdict(outcome.run.metrics).items()}
    if with_settings:
        values["set"] = dict(case.overrides)
    if with_scenario:
        span, ended = outcome.run.disturbance, outcome.run.ended or None
        values |= {"scenario": case.labels["scenario"], "ended": ended}
        values |= {"disturbance_s": None if span is None else [_plain(instant) for instant in span]}
        values |= {name: _plain(value) for name, value in asdict(outcome.run.recovery).items()}
    return values


def describe(experiment: Experiment, wall_time: float, cpu_share: float) -> dict[str, object]:
    """The `meta` part: versions, machine, definitions, and what was asked for.

    Parameters
    ----------
    experiment
        What was asked for.
    wall_time
        How long the runs and their timing took [s].
    cpu_share
        Processor time over elapsed time of the timing pass [-].
    """
    asked = experiment.model_dump(mode="json", exclude={"config", "settings"})
    for name in ("controllers", "models", "trajectories", "plants", "surfaces", "sensors", "scenarios"):
        asked[name] = [label(text) for text in asked[name]]
    ours = not set(experiment.controllers) <= set(PEERS)
    if not ours:
        asked["models"] = []
    return {
        **describe_run(wall_time),
        "step_times": TIMING,
        "step_times_cpu_share": round(cpu_share, 3),
        "statistics": STATISTICS,
        "thresholds": metric_settings().model_dump(),
        "experiment": asked,
        "configuration": {
            "file": _stem(experiment.config),
            "set": {key: list(values) for key, values in _swept(experiment).items()},
            "controllers": _configurations(experiment) if ours else [],
        },
    }


def chosen_configuration(experiment: Experiment) -> str:
    """The configuration file and the values in place of the shipped ones, as one phrase; empty without any."""
    parts = [] if experiment.config is None else [f"file {_stem(experiment.config)}"]
    parts += [f"{key}={','.join(map(str, values))}" for key, values in _swept(experiment).items()]
    return "; ".join(parts)


def _configurations(experiment: Experiment) -> list[dict[str, object]]:
    """Every value that each model's controller was given, for each combination of swept values."""
    return [
        {
            "model": label(model),
            "set": dict(overrides),
            "values": controller_config(model, experiment.config, overrides).model_dump(mode="json")
            | {"model": label(model)},  # a path would tell of the machine
        }
        for model in experiment.models
        for overrides in experiment.settings
    ]


def _swept(experiment: Experiment) -> dict[str, list[object]]:
    """Values by dotted key, each once."""
    values: dict[str, list[object]] = {}
    for key, value in (pair for overrides in experiment.settings for pair in overrides):
        known = values.setdefault(key, [])
        if value not in known:
            known.append(value)
    return values


def _stem(path: str | None) -> str | None:
    return None if path is None else Path(path).stem


def _plain(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value
