"""Factors of a campaign: a value, a choice or a distribution, which maps a point of (0, 1) to a value."""

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

# Logarithms and quantiles differ in the last bits from one machine to the next, and would give a run another hash.
_DIGITS = 9


class Draw(StrictModel, ABC):
    """A factor that differs from run to run."""

    @abstractmethod
    def value(self, point: float, index: int) -> Value:
        """Return the value of run `index` whose coordinate in (0, 1) is `point`."""

    @property
    def sampled(self) -> bool:
        """True if the factor needs a coordinate."""
        return True


class Uniform(Draw):
    """Every value between two is as likely."""

    uniform: Range = Field(description="lowest and highest value")

    @model_validator(mode="after")
    def _ordered(self) -> Uniform:
        _check_ordered(self.uniform)
        return self

    def value(self, point: float, index: int) -> Value:  # noqa: ARG002
        """Compute the quantile."""
        low, high = self.uniform
        return _rounded(low + point * (high - low))


class LogUniform(Draw):
    """Every factor between two values is as likely."""

    log_uniform: Range = Field(description="lowest and highest value, above zero")

    @model_validator(mode="after")
    def _ordered(self) -> LogUniform:
        _check_ordered(self.log_uniform)
        if not self.log_uniform[0] > 0.0:
            raise ValueError(f"log_uniform takes values above zero (found {self.log_uniform[0]:g})")
        return self

    def value(self, point: float, index: int) -> Value:  # noqa: ARG002
        """Compute the quantile."""
        low, high = map(math.log, self.log_uniform)
        return _rounded(math.exp(low + point * (high - low)))


class NormalValues(StrictModel):
    """A normal distribution, cut off where `low` or `high` is given."""

    mean: float = Field(description="before cutting")
    sd: Annotated[float, Field(gt=0)] = Field(description="standard deviation before cutting")
    low: float | None = Field(None, description="no value is lower")
    high: float | None = Field(None, description="no value is higher")

    @model_validator(mode="after")
    def _ordered(self) -> NormalValues:
        if self.low is not None and self.high is not None:
            _check_ordered((self.low, self.high))
        low, high = self.shares
        if not high > low:
            raise ValueError("nothing of the normal distribution lies between low and high")
        return self

    @property
    def shares(self) -> Range:
        """Shares of the whole distribution below `low` and below `high`."""
        low = 0.0 if self.low is None else float(ndtr((self.low - self.mean) / self.sd))
        return low, 1.0 if self.high is None else float(ndtr((self.high - self.mean) / self.sd))


class Normal(Draw):
    """A normal distribution, truncated where bounds are given."""

    normal: NormalValues

    def value(self, point: float, index: int) -> Value:  # noqa: ARG002
        """Compute the quantile."""
        normal = self.normal
        low, high = normal.shares
        drawn = _rounded(normal.mean + normal.sd * float(ndtri(low + point * (high - low))))
        # Rounding must not lead beyond.
        return min(
            max(drawn, drawn if normal.low is None else normal.low), drawn if normal.high is None else normal.high
        )


class OneOf(Draw):
    """A choice: a list of equally likely values, or values with their weights."""

    one_of: tuple[Value, ...] | dict[str, Annotated[float, Field(gt=0)]]

    @model_validator(mode="after")
    def _something(self) -> OneOf:
        if not self.one_of:
            raise ValueError("one_of takes at least one value")
        return self

    def value(self, point: float, index: int) -> Value:  # noqa: ARG002
        """Return the value whose share contains `point`."""
        values = list(self.one_of)
        weights = [*self.one_of.values()] if isinstance(self.one_of, dict) else [1.0] * len(values)
        upper = list(itertools.accumulate(weights))
        # The last one where rounding leaves something.
        return values[min(bisect.bisect_right(upper, point * upper[-1]), len(values) - 1)]


class Integers(Draw):
    """Every whole number between two, both included, is as likely."""

    integers: tuple[int, int] = Field(description="lowest and highest")

    @model_validator(mode="after")
    def _ordered(self) -> Integers:
        _check_ordered(self.integers)
        return self

    def value(self, point: float, index: int) -> Value:  # noqa: ARG002
        """Return the number whose share contains `point`."""
        low, high = self.integers
        return min(low + int(point * (high - low + 1)), high)


class Counted(Draw, ABC):
    """Another value for each run, in order."""

    @property
    def sampled(self) -> bool:
        """It needs no coordinate: it counts."""
        return False


class Each(Counted):
    """Another number for each run: the first one, the next, ..."""

    each: Annotated[int, Field(ge=0)] = Field(description="number of the first run")

    def value(self, point: float, index: int) -> Value:  # noqa: ARG002
        """Return its number."""
        return self.each + index


class MarketDraw(Counted):
    """Another robot of the market for each run: the reserved ones that can drive and turn on the spot, in order."""

    market: Annotated[int, Field(ge=0)] = Field(description="number of the first run's, for the factor `plant`")

    def value(self, point: float, index: int) -> Value:  # noqa: ARG002
        """Return the name of its plant."""
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
    """Read a factor of a file; raise ConfigError if it is none. `where` names its place."""
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
