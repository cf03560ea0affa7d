"""Row of a run: all columns of tables, figures, JSON and Parquet files."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from diffdrive_mpc.bench.case import DIMENSIONS, Case, describe_setting
from diffdrive_mpc.models.function_structure import function_structures
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.mpc import Trajectory
from diffdrive_mpc.sim import Run
from diffdrive_mpc.sim.plants.plug_ins import columns_of
from diffdrive_mpc.sim.run import NO_SOLVER

Row = dict[str, Any]
CLOCK = ("step_time", "solve_time", "deadline")
"""Prefixes of columns that differ between repetitions of a run."""
STATISTICS = "true pose relative to the reference, from t = 0 to the end of the reference without a settling time"
"""Definition of the errors in reports."""


@dataclass(frozen=True)
class SolverShares:
    """Shares of the solver's methods in the ticks with a solve [%], and number of counted ticks without a solve.

    Unlimited: no limit was active. Active set: the guessed active set was verified. Backend: OSQP or DAQP found the
    solution. The shares are NaN if no tick has a solve.
    """

    method_unlimited_percent: float
    method_active_set_percent: float
    method_backend_percent: float
    not_solved: int

    @classmethod
    def from_run(cls, run: Run) -> SolverShares:
        """Compute the shares of the counted ticks of `run`."""
        ticks = Counter(method for method, counted in zip(run.solver_methods, run.counted, strict=True) if counted)
        solved = ticks.total() - ticks[NO_SOLVER]

        def share(*methods: str) -> float:
            return 100.0 * sum(ticks[method] for method in methods) / solved if solved else math.nan

        return cls(share("unlimited"), share("active_set"), share("osqp", "daqp"), ticks[NO_SOLVER])


@dataclass(frozen=True)
class RunOutcome:
    """Case and its run.

    `clean_share` is the share of ticks that were timed without disturbance, or NaN if the run was not timed. Times of
    disturbed ticks are NaN, except if all ticks of a controller were disturbed; see `bench.timing.time_outcomes`.
    """

    case: Case
    run: Run
    clean_share: float = 1.0

    @property
    def without_times(self) -> RunOutcome:
        """Outcome without step times, for runs that were disturbed by parallel runs."""
        no_times = np.full(len(self.run.time), np.nan)
        return replace(self, run=self.run.with_step_time(no_times, no_times), clean_share=math.nan)

    @property
    def row(self) -> Row:
        """Row of the run with the run itself, the clean share, and distances of the reference from the drawn path."""
        times, reference = self.run.time[self.run.counted], self.run.reference
        distance = reference.drawn_distance(times) if isinstance(reference, Trajectory) else np.zeros(times.size)
        return row_of(self.case, self.run) | {
            "horizon": self.case.horizon,
            "run": self.run,
            "clean_share": self.clean_share,
            "drawn_max_m": float(distance.max()),
            "drawn_rms_m": float(np.sqrt(np.mean(distance**2))),
        }


def row_of(case: Case, run: Run) -> Row:
    """Build the row of a run: case, name of the controller, dimensions of the case, and `run_columns`."""
    return {"case": case, "driver": driver_name(case)} | case.as_row() | run_columns(run)


def statistics_of(run: Run, *, timed: bool = True) -> Row:
    """Compute the metrics and the shares of the solver's methods, without the columns in `CLOCK` if not `timed`."""
    values = asdict(run.metrics) | asdict(SolverShares.from_run(run))
    return {name: value for name, value in values.items() if timed or not name.startswith(CLOCK)}


def run_columns(run: Run) -> Row:
    """Compute statistics, recovery, duration, end, most frequent message, and the columns of the run's parts."""
    messages = Counter(message for message in run.messages if message)
    return {
        **statistics_of(run),
        "driven_s": float(run.time[-1]),
        "ended": run.ended,
        "last_mode": run.modes[-1],
        "message": messages.most_common(1)[0][0] if messages else "",
        "message_percent": 100.0 * messages.total() / len(run.messages),
        **{f"recovery_{name.removeprefix('recovery_')}": value for name, value in asdict(run.recovery).items()},
        **{name: value for part in columns_of(run) for name, value in part.row(run).items()},
    }


def driver_name(case: Case) -> str:
    """Return the name of the predictive controller's model, or the name of a peer."""
    labels = case.labels
    return model_name(labels["model"]) if labels["controller"] == "mpc" else labels["controller"]


def model_name(name: str) -> str:
    """Return the name of a model in the papers, or the name of the user's file."""
    if name in STRUCTURES:
        return name.replace("_", " ") if "_" in name else name.upper()
    return {
        function_structure.name: function_structure.title for function_structure in function_structures().values()
    }.get(name, name)


def driver_names(cases: Sequence[Case]) -> list[str]:
    """Name the compared controllers by model or peer and by the dimensions and settings that vary between the cases."""
    labels = [case.labels for case in cases]
    varying = [
        dimension
        for dimension in DIMENSIONS
        if dimension.place and len({labels_of_case[dimension.name] for labels_of_case in labels}) > 1
    ]
    overrides_vary = len({case.overrides for case in cases if case.controller == "mpc"}) > 1
    names = []
    for case, labels_of_case in zip(cases, labels, strict=True):
        parts = [driver_name(case)]
        parts += [
            labels_of_case[entry.name] if entry.kind is str else f"{entry.name}={labels_of_case[entry.name]}"
            for entry in varying
        ]
        parts += map(describe_setting, case.overrides) if overrides_vary else ()
        names.append(", ".join(parts))
    return names
