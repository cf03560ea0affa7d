"""Structures of velocity models that plug-ins bring: functions, where `models.structures` has matrices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diffdrive_mpc.models.plug_ins import plug_ins

if TYPE_CHECKING:
    from pydantic import BaseModel

    from diffdrive_mpc.models.identification.fit.predictor import Finder
    from diffdrive_mpc.models.nonlinear_model import NonlinearModel


@dataclass(frozen=True)
class FunctionStructure:
    """One structure. Listing names imports none of the named modules.

    Attributes
    ----------
    structure
        Name of the structure in its parameter files.
    name
        Name of the shipped model and of the structure in `identify --structure`.
    title
        For tables.
    rank
        Place among the others, the simplest first: a later one must predict better by more than chance.
    package
        In which the following are, each as "module:name".
    loader
        A function of the path of a parameter file and its content; returns the model.
    file
        Schema of the parameter files, a pydantic model.
    finder_function
        Function that identifies such a model from a log, a `Finder`.
    check
        Function that raises MissingPackageError where a package that the finder needs is not installed; empty for
        nothing.
    shipped
        Parameter file of its shipped model, if it exists.
    config
        Configuration of a controller with that model, if it exists; `load_config` reads it by `name`.
    robots
        Parameter files of named robots; a model is loaded by the stem of its file.
    slow
        Whether it is slow: then a comparison leaves it out unless it is named.
    """

    structure: str
    name: str
    title: str
    rank: int
    package: str
    loader: str
    file: str
    finder_function: str
    check: str = ""
    shipped: Path | None = None
    config: Path | None = None
    robots: tuple[Path, ...] = ()
    slow: bool = False

    def load(self, path: Path, data: Any) -> NonlinearModel:  # noqa: ANN401 - what a YAML file may hold
        """Load the model of the parameter file at `path` with the content `data`; raise ConfigError or ModelError."""
        model: NonlinearModel = self._named(self.loader)(path, data)
        return model

    def schema(self) -> type[BaseModel]:
        """Return the schema of its parameter files."""
        schema: type[BaseModel] = self._named(self.file)
        return schema

    def finder(self) -> Finder:
        """Return the finder of such a model in a log; raise MissingPackageError without its dependencies."""
        if self.check:
            self._named(self.check)()
        finder: Finder = self._named(self.finder_function)
        return finder

    def _named(self, place: str) -> Any:  # noqa: ANN401 - each place holds something else
        module, _, name = place.partition(":")
        return getattr(import_module(f"{self.package}.{module}"), name)


def function_structures() -> Mapping[str, FunctionStructure]:
    """Return all structures by the name in their files, the simplest first."""
    return {
        structure.structure: structure
        for structure in sorted(plug_ins("structures"), key=lambda structure: structure.rank)
    }
