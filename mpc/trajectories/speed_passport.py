"""A speed passport: how fast a robot may drive each curvature and stay within a tolerance of its path.

`diffdrive-mpc prove --tolerance` measures one and writes it; `timing: smooth` keeps to one.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.trust import check_trusted

Share = Annotated[float, Field(gt=0, lt=1)]
# Of a curvature: rounding makes a straight line turn by less [1/m].
_STRAIGHT = 1e-9


class PassportUse(StrictModel):
    """Speed passport of a trajectory and the tolerance to use."""

    file: str = Field(min_length=1, description="passport, from the folder of the trajectory")
    tolerance: float = Field(gt=0, description="largest lateral error [m]")
    surface: str | None = Field(default=None, description="surface of the passport; default: the slowest of all")


class PassportRow(StrictModel):
    """The speeds of one surface and tolerance."""

    surface: str = Field(description="name of the surface")
    tolerance: float = Field(gt=0, description="largest lateral error [m]")
    speeds: list[Annotated[float, Field(gt=0)] | None] = Field(
        description="greatest speed of each class of curvature [m/s]; null where none was proven"
    )


class SpeedPassport(StrictModel):
    """Greatest speeds at which a share of the robots stays within a tolerance."""

    description: str = Field(description="controller and robots for which it holds")
    share: Share = Field(description="of the robots that stay inside, at least [-]")
    confidence: Share = Field(description="of each speed by itself [-]")
    curvatures: list[Annotated[float, Field(ge=0)]] = Field(
        min_length=1,
        description="classes, each from the one before to its own value; the first from 0 [1/m]",
    )
    rows: list[PassportRow] = Field(min_length=1, description="a row for each surface and tolerance")

    @model_validator(mode="after")
    def _is_a_table(self) -> SpeedPassport:
        if any(low >= high for low, high in pairwise(self.curvatures)):
            raise ValueError("curvatures must increase")
        if any(len(row.speeds) != len(self.curvatures) for row in self.rows):
            raise ValueError(f"each row needs a speed for each of the {len(self.curvatures)} curvatures")
        if len({(row.surface, row.tolerance) for row in self.rows}) < len(self.rows):
            raise ValueError("two rows have the same surface and tolerance")
        return self


@dataclass(frozen=True)
class SpeedCaps:
    """The greatest speed by curvature.

    Attributes
    ----------
    curvatures
        (k,) upper ends of the classes [1/m], rising.
    speeds
        (k,) [m/s]; NaN where there is none.
    where
        Names the passport, surface and tolerance in messages.
    """

    curvatures: FloatArray
    speeds: FloatArray
    where: str

    def speeds_of(self, bend: FloatArray) -> FloatArray:
        """Return the maximum speed [m/s] for |curvature| `bend` (m,) [1/m]: the lowest of its class and wider ones.

        Raises
        ------
        models.checked_yaml.ConfigError
            If the path turns more tightly than any class, or no speed was proven for one that it needs.
        """
        tightest = float(bend.max())
        if tightest > self.curvatures[-1] + _STRAIGHT:
            raise ConfigError(
                f"{self.where}: the path turns with a curvature of {tightest:.3g} 1/m, the passport has none above "
                f"{self.curvatures[-1]:.3g} 1/m; widen the turn, or measure a passport with such curvatures"
            )
        # Between two classes the slower one counts, also where chance made the tighter one faster.
        speeds = np.minimum.accumulate(self.speeds)[np.searchsorted(self.curvatures + _STRAIGHT, bend)]
        if np.isnan(speeds).any():
            curvature = float(bend[np.isnan(speeds)].min())
            raise ConfigError(
                f"{self.where}: no speed is proven for a curvature of {curvature:.3g} 1/m or less; "
                "choose a larger speed_passport.tolerance, or a wider turn"
            )
        return np.asarray(speeds)


def load_speed_caps(use: PassportUse, folder: Path) -> SpeedCaps:
    """Read the passport that a trajectory in `folder` names, and take the speeds of its tolerance and surface.

    Between two tolerances the smaller counts.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file is missing or has a mistake, the surface is unknown, or the tolerance is below all of the passport.
    models.trust.UntrustedFileError
        If the file may not be opened.
    """
    path = folder / use.file
    check_trusted(path)
    passport = load_checked(SpeedPassport, path)
    surfaces = list(dict.fromkeys(row.surface for row in passport.rows))
    if use.surface is not None and use.surface not in surfaces:
        raise ConfigError(f"{path}: unknown surface '{use.surface}'; known: {', '.join(surfaces)}")
    where = f"{path}, {use.surface or 'all surfaces'}, {use.tolerance:g} m"
    rows = []
    for surface in surfaces if use.surface is None else [use.surface]:
        usable = [row for row in passport.rows if row.surface == surface and row.tolerance <= use.tolerance]
        if not usable:
            least = min(row.tolerance for row in passport.rows if row.surface == surface)
            raise ConfigError(f"{where}: the least tolerance of the passport is {least:g} m; allow as much")
        best = max(usable, key=lambda row: row.tolerance)
        rows.append([np.nan if speed is None else speed for speed in best.speeds])
    return SpeedCaps(np.array(passport.curvatures), np.min(np.array(rows), axis=0), where)
