"""Speed passports: maximum speed by curvature for which a robot stays within a tolerance of its path.

`diffdrive-mpc prove --tolerance` measures and writes a passport; `timing: smooth` limits the speed by a passport.
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
from diffdrive_mpc.models.suggestions import format_unknown_name
from diffdrive_mpc.models.trust import check_trusted

Share = Annotated[float, Field(gt=0, lt=1)]
# Tolerance for rounding when a curvature is compared with the end of a class [1/m].
_STRAIGHT = 1e-9


class PassportUse(StrictModel):
    """Speed passport and tolerance that a trajectory uses."""

    file: str = Field(min_length=1, description="path of the passport, relative to the folder of the trajectory")
    tolerance: float = Field(gt=0, description="maximum lateral error [m]")
    surface: str | None = Field(default=None, description="surface in the passport; default: the slowest surface")


class PassportRow(StrictModel):
    """Speeds for a surface and a tolerance."""

    surface: str = Field(description="name of the surface")
    tolerance: float = Field(gt=0, description="maximum lateral error [m]")
    speeds: list[Annotated[float, Field(gt=0)] | None] = Field(
        description="maximum speed for each class of curvature [m/s]; null for classes without a proven speed"
    )


class SpeedPassport(StrictModel):
    """Maximum speeds at which a share of the robots stays within a tolerance."""

    description: str = Field(description="controller and robots for which the passport is valid")
    share: Share = Field(description="minimum share of the robots within the tolerance [-]")
    confidence: Share = Field(description="confidence level of each speed [-]")
    curvatures: list[Annotated[float, Field(ge=0)]] = Field(
        min_length=1, description="upper ends of the classes of curvature; the first class starts at 0 [1/m]"
    )
    rows: list[PassportRow] = Field(min_length=1, description="speeds for each surface and tolerance")

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
    """Maximum speed by curvature.

    Attributes
    ----------
    curvatures
        (k,) upper ends of the classes [1/m], increasing.
    speeds
        (k,) maximum speed of each class [m/s]; NaN for classes without a proven speed.
    where
        Passport, surface and tolerance, for messages.
    """

    curvatures: FloatArray
    speeds: FloatArray
    where: str

    def speeds_of(self, bend: FloatArray) -> FloatArray:
        """Return the maximum speed (m,) [m/s] for the absolute curvature `bend` (m,) [1/m].

        The speed is the minimum over the class of the curvature and all classes of lower curvature.

        Raises
        ------
        models.checked_yaml.ConfigError
            If a curvature exceeds all classes, or its class has no proven speed.
        """
        maximum = float(bend.max())
        if maximum > self.curvatures[-1] + _STRAIGHT:
            raise ConfigError(
                f"{self.where}: the path turns with a curvature of {maximum:.3g} 1/m, the passport has none above "
                f"{self.curvatures[-1]:.3g} 1/m; widen the turn, or measure a passport with such curvatures"
            )
        # The speed must not increase with the curvature; a measured speed of a tighter class may be higher by chance.
        speeds = np.minimum.accumulate(self.speeds)[np.searchsorted(self.curvatures + _STRAIGHT, bend)]
        if np.isnan(speeds).any():
            curvature = float(bend[np.isnan(speeds)].min())
            raise ConfigError(
                f"{self.where}: no speed is proven for a curvature of {curvature:.3g} 1/m or less; "
                "choose a larger speed_passport.tolerance, or a wider turn"
            )
        return np.asarray(speeds)


def load_speed_caps(use: PassportUse, folder: Path) -> SpeedCaps:
    """Load the passport of a trajectory in `folder`, and select the speeds for its tolerance and surface.

    If the passport does not contain the tolerance, the speeds for the next lower tolerance are used.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file is missing or invalid, the surface is unknown, or the tolerance is below those of the passport.
    models.trust.UntrustedFileError
        If the file is not trusted.
    """
    path = folder / use.file
    check_trusted(path)
    passport = load_checked(SpeedPassport, path)
    surfaces = list(dict.fromkeys(row.surface for row in passport.rows))
    if use.surface is not None and use.surface not in surfaces:
        raise ConfigError(f"{path}: unknown surface {format_unknown_name(use.surface, surfaces)}")
    where = f"{path}, {use.surface or 'all surfaces'}, {use.tolerance:g} m"
    rows = []
    for surface in surfaces if use.surface is None else [use.surface]:
        usable = [row for row in passport.rows if row.surface == surface and row.tolerance <= use.tolerance]
        if not usable:
            min_tolerance = min(row.tolerance for row in passport.rows if row.surface == surface)
            raise ConfigError(
                f"{where}: the minimum tolerance of the passport is {min_tolerance:g} m; give at least this"
            )
        best = max(usable, key=lambda row: row.tolerance)
        rows.append([np.nan if speed is None else speed for speed in best.speeds])
    return SpeedCaps(np.array(passport.curvatures), np.min(np.array(rows), axis=0), where)
