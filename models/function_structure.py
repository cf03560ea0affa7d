"""Structures of velocity models that plug-ins bring: functions, where `models.structures` has matrices."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diffdrive_mpc.models.plug_ins import plug_ins

if TYPE_CHECKING:
    from pydantic import BaseModel

    from diffdrive_mpc.models.identification.predictor import Finder
    from diffdrive_mpc.models.nonlinear_model import NonlinearModel


@dataclass(frozen=True)
class FunctionStructure:
    """One structure. What loads CasADi or more stands behind functions, for who only asks for names.

    Attributes
    ----------
    structure
        What its parameter files say it is.
    name
        Of its shipped model, and what `identify --structure` calls it.
    title
        For tables.
    rank
        Place among the others, the simplest first: a later one has to predict better by more than chance.
    load
        The model of the parameter file at a path, whose content is given.
    schema
        What its parameter files are checked by.
    finder
        What finds one in a log; raises MissingPackageError where what it needs is not installed.
    shipped
        The parameter file of its shipped model, if there is one.
    slow
        Whether a comparison leaves it out unless it is named.
    """

    structure: str
    name: str
    title: str
    rank: int
    load: Callable[[Path, Any], NonlinearModel]
    schema: Callable[[], type[BaseModel]]
    finder: Callable[[], Finder]
    shipped: Path | None = None
    slow: bool = False


def function_structures() -> Mapping[str, FunctionStructure]:
    """All that are there by what their files call them, the simplest first."""
    return {one.structure: one for one in sorted(plug_ins("structures"), key=lambda one: one.rank)}
