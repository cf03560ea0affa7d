"""What a run of the speed benchmark gave."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from diffdrive_mpc.bench.speed.outcome.record import Measured, Missing, Record, growth_exponent

ACADOS = "acados"
"""The peer that ratios refer to."""
GROWTH_FROM = 20
"""Shortest horizon that counts for the growth: below it what does not depend on the horizon prevails."""


@dataclass(frozen=True)
class SpeedResults:
    """Records, the times behind them, and who is missing.

    Attributes
    ----------
    measured, missing
        In the order of the run.
    meta
        Machine, versions, settings.
    """

    measured: tuple[Measured, ...]
    missing: tuple[Missing, ...]
    meta: dict[str, object]

    @property
    def records(self) -> tuple[Record, ...]:
        """All records."""
        return tuple(one.record for one in self.measured)

    @property
    def models(self) -> tuple[str, ...]:
        """Models, in order of appearance."""
        return tuple(dict.fromkeys(record.model for record in self.records))

    @property
    def horizons(self) -> tuple[int, ...]:
        """Horizons, ascending."""
        return tuple(sorted({record.horizon for record in self.records}))

    @property
    def solvers(self) -> tuple[str, ...]:
        """Solvers, in order of appearance, those that are missing everywhere left out."""
        return tuple(dict.fromkeys(record.solver for record in self.records))

    def find(self, solver: str, model: str, horizon: int) -> Record | None:
        """One record, if there is one."""
        wanted = (solver, model, horizon)
        return next((r for r in self.records if (r.solver, r.model, r.horizon) == wanted), None)

    def value(self, solver: str, model: str, horizon: int, field: Callable[[Record], float]) -> float:
        """A value of one record; NaN if there is none."""
        record = self.find(solver, model, horizon)
        return float("nan") if record is None else field(record)

    def growth(self, solver: str, model: str) -> float:
        """Exponent of the whole step's median over the horizons from `GROWTH_FROM` on; NaN with fewer than two."""
        found = [r for r in self.records if (r.solver, r.model) == (solver, model) and r.horizon >= GROWTH_FROM]
        return growth_exponent(
            np.array([r.horizon for r in found], dtype=float), np.array([r.step_p50_s for r in found])
        )

    def as_json(self) -> dict[str, object]:
        """`{"meta": ..., "records": [...], "missing": [...], "growth": [...]}` of plain values."""
        growth = [
            {"solver": solver, "model": model, "exponent": round(exponent, 3)}
            for model in self.models
            for solver in self.solvers
            if np.isfinite(exponent := self.growth(solver, model))
        ]
        return {
            "meta": self.meta,
            "records": [record.as_json() for record in self.records],
            "missing": [asdict(missing) for missing in self.missing],
            "growth": growth,
        }
