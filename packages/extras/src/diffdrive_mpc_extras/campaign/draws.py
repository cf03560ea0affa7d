"""Factors of a campaign: a value, a choice or a distribution, which maps a point in (0, 1) to a value."""

from __future__ import annotations

import bisect
import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Annotated

from pydantic import Field, model_validator
from scipy.special import ndtr, ndtri

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, check
from diffdrive_mpc.sim.plants.names import DRAWN
from diffdrive_mpc_extras.campaign.drivable_robots import driving_seeds

Value = bool | int | float | str
"""Value of a factor in one run."""
Range = tuple[float, float]

# Logarithms and quantiles depend on the machine in their last bits, so values are rounded before they are hashed.
_DIGITS = 9


class Draw(StrictModel, ABC):
    """Factor that varies from run to run."""

    @abstractmethod
    def value(self, point: float, index: int) -> Value:
        """Return the value of run `index` for the coordinate `point` in (0, 1)."""

    @property
    def sampled(self) -> bool:
        """True if the factor needs a coordinate of a sampled point."""
        return True


class Uniform(Draw):
    """Uniform distribution between two values."""

    uniform: Range = Field(description="minimum and maximum")

    @model_validator(mode="after")
    def _ordered(self) -> Uniform:
        _check_ordered(self.uniform)
        return self

    def value(self, point: float, index: int) -> Value:  # noqa: ARG002
        """Compute the quantile."""
        low, high = self.uniform
        return _rounded(low + point * (high - low))


class LogUniform(Draw):
    """Log-uniform distribution between two positive values."""

    log_uniform: Range = Field(description="minimum and maximum, both above zero")

    @model_validator(mode="after")
    def _ordered(self) -> LogUniform:
        _check_ordered(self.log_uniform)
        if not self.log_uniform[0] > 0.0:
            raise ValueError(f"log_uniform needs values above zero (found {self.log_uniform[0]:g})")
        return self

    def value(self, point: float, index: int) -> Value:  # noqa: ARG002
        """Compute the quantile."""
        low, high = map(math.log, self.log_uniform)
        return _rounded(math.exp(low + point * (high - low)))


class NormalValues(StrictModel):
    """Parameters of a normal distribution, truncated at `low` and `high` if they are given."""

    mean: float = Field(description="mean before truncation")
    sd: Annotated[float, Field(gt=0)] = Field(description="standard deviation before truncation")
    low: float | None = Field(None, description="lower bound")
    high: float | None = Field(None, description="upper bound")

    @model_validator(mode="after")
    def _ordered(self) -> NormalValues:
        if self.low is not None and self.high is not None:
            _check_ordered((self.low, self.high))
        low, high = self.probabilities
        if not high > low:
            raise ValueError("the normal distribution has no probability between low and high")
        return self

    @property
    def probabilities(self) -> Range:
        """Probabilities below `low` and below `high` before truncation."""
        low = 0.0 if self.low is None else float(ndtr((self.low - self.mean) / self.sd))
        return low, 1.0 if self.high is None else float(ndtr((self.high - self.mean) / self.sd))


class Normal(Draw):
    """Normal distribution, truncated at the bounds that are given."""

    normal: NormalValues

    def value(self, point: float, index: int) -> Value:  # noqa: ARG002
        """Compute the quantile."""
        normal = self.normal
        low, high = normal.probabilities
        quantile = _rounded(normal.mean + normal.sd * float(ndtri(low + point * (high - low))))
        # Clip because rounding can exceed a bound.
        return min(
            max(quantile, quantile if normal.low is None else normal.low),
            quantile if normal.high is None else normal.high,
        )


class OneOf(Draw):
    """Choice from a list of equally likely values, or from values with weights."""

    one_of: tuple[Value, ...] | dict[str, Annotated[float, Field(gt=0)]]

    @model_validator(mode="after")
    def _check_not_empty(self) -> OneOf:
        if not self.one_of:
            raise ValueError("one_of needs at least one value")
        return self

    def value(self, point: float, index: int) -> Value:  # noqa: ARG002
        """Return the value whose interval of the cumulative weights contains `point`."""
        values = list(self.one_of)
        weights = [*self.one_of.values()] if isinstance(self.one_of, dict) else [1.0] * len(values)
        upper = list(itertools.accumulate(weights))
        # Rounding can lead past the last value.
        return values[min(bisect.bisect_right(upper, point * upper[-1]), len(values) - 1)]


class Integers(Draw):
    """Uniform distribution of the integers between two values, both included."""

    integers: tuple[int, int] = Field(description="minimum and maximum")

    @model_validator(mode="after")
    def _ordered(self) -> Integers:
        _check_ordered(self.integers)
        return self

    def value(self, point: float, index: int) -> Value:  # noqa: ARG002
        """Return the integer whose interval contains `point`."""
        low, high = self.integers
        return min(low + int(point * (high - low + 1)), high)


class Counted(Draw, ABC):
    """Factor whose value depends on the index of the run."""

    @property
    def sampled(self) -> bool:
        """False, because the value depends only on the index."""
        return False


class Each(Counted):
    """Consecutive numbers, one for each run."""

    each: Annotated[int, Field(ge=0)] = Field(description="number of the first run")

    def value(self, point: float, index: int) -> Value:  # noqa: ARG002
        """Return the number of the run."""
        return self.each + index


class MarketDraw(Counted):
    """Consecutive robots of the population: the reserved robots that can drive and turn on the spot, in order."""

    market: Annotated[int, Field(ge=0)] = Field(description="number of the first run's robot, for the factor `plant`")

    def value(self, point: float, index: int) -> Value:  # noqa: ARG002
        """Return the name of the run's plant."""
        number = self.market + index
        return f"{DRAWN}:{driving_seeds(number + 1, spot_turns=True)[number]}"


KINDS: dict[str, type[Draw]] = {
    "uniform": Uniform,
    "log_uniform": LogUniform,
    "normal": Normal,
    "one_of": OneOf,
    "integers": Integers,
    "each": Each,
    "market": MarketDraw,
}


def read_factor(data: object, where: str) -> Draw | Value:
    """Parse a factor of a file; raises ConfigError if it is invalid. `where` is its key for messages."""
    if isinstance(data, (bool, int, str)) or (isinstance(data, float) and math.isfinite(data)):
        return data
    if isinstance(data, Mapping) and len(data) == 1 and next(iter(data)) in KINDS:
        return check(KINDS[next(iter(data))], data, where)
    raise ConfigError(f"{where}: give a value, or one of {{{'}, {'.join(f'{kind}: ...' for kind in KINDS)}}}")


def _check_ordered(ends: tuple[float, float]) -> None:
    if not ends[0] <= ends[1]:
        raise ValueError(f"give the lower value first (found {ends[0]:g}, {ends[1]:g})")


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
