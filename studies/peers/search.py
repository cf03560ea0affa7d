"""A search with a fixed number of evaluations: a Sobol scan, then the best one refined gain by gain."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import qmc

Values = dict[str, float]
Objective = Callable[[Values], float]
_DIGITS = 4


@dataclass
class Search:
    """Minimises a function of positive values within ranges, on a logarithmic scale.

    Attributes
    ----------
    objective
        What is to be small.
    ranges
        Lowest and highest value of each.
    evaluations
        How often `objective` may be called.
    tried
        Every setting with its objective, in order.
    """

    objective: Objective
    ranges: Mapping[str, tuple[float, float]]
    evaluations: int
    tried: list[tuple[Values, float]] = field(default_factory=list)

    @property
    def best(self) -> tuple[Values, float]:
        """The setting with the least objective; of equals the first."""
        return min(self.tried, key=lambda one: one[1])

    def scan(self, count: int, seed: int) -> None:
        """Try the middle of the ranges and `count` - 1 points of a scrambled Sobol sequence."""
        low, high = np.log(np.array(list(self.ranges.values()), dtype=float)).T
        points = qmc.Sobol(len(low), seed=seed).random_base2(int(np.ceil(np.log2(max(count, 2)))))
        for point in [np.full(len(low), 0.5), *points][:count]:
            self._try(dict(zip(self.ranges, np.exp(low + point * (high - low)).tolist(), strict=True)))

    def refine(self, factor: float) -> None:
        """Multiply and divide one value after another by `factor`, which shrinks to its root when nothing helps."""
        while len(self.tried) < self.evaluations:
            before = self.best[1]
            for name in self.ranges:
                if not self._step(name, factor):
                    self._step(name, 1 / factor)
            if self.best[1] >= before:
                factor = float(np.sqrt(factor))
                if factor < 1.01:
                    return

    def _step(self, name: str, factor: float) -> bool:
        """Go on in one direction as long as it helps; whether it did."""
        helped = False
        while len(self.tried) < self.evaluations:
            values, least = self.best
            low, high = self.ranges[name]
            moved = values | {name: float(np.clip(values[name] * factor, low, high))}
            if moved == values or not self._try(moved) < least:
                return helped
            helped = True
        return helped

    def _try(self, values: Values) -> float:
        rounded = {name: float(f"{value:.{_DIGITS}g}") for name, value in values.items()}
        for known, found in self.tried:
            if known == rounded:
                return found
        found = self.objective(rounded)
        self.tried.append((rounded, found))
        return found
