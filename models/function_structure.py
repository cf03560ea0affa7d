"""Structures of velocity models from plug-ins, defined by functions instead of matrices as in `models.structures`."""

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
    """Structure of a velocity model. Modules are given by name and imported on use, so that listing does not import.

    Attributes
    ----------
    structure
        Name of the structure in its parameter files.
    name
        Name of the shipped model and of the structure in `identify --structure`.
    title
        Title in tables.
    rank
        Rank by complexity, from the simplest: a structure of higher rank must predict significantly better.
    package
        Package of the objects below, each named as "module:name".
    loader
        Function of the path of a parameter file and its content; returns the model.
    file
        Schema of the parameter files, a pydantic model.
    finder_function
        Function that identifies such a model from a log, a `Finder`.
    check
        Function that raises MissingPackageError if a package that the finder needs is not installed; empty for no
        check.
    shipped
        Parameter file of the shipped model, if there is one.
    config
        Configuration of a controller with that model, if there is one; `load_config` reads it by `name`.
    robots
        Parameter files of named robots; a model is loaded by the stem of its file.
    slow
        True if identification is slow; a comparison then skips the structure unless it is named.
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

    def load(self, path: Path, data: Any) -> NonlinearModel:  # noqa: ANN401 - content of a YAML file
        """Load the model of the parameter file at `path` with the content `data`; raise ConfigError or ModelError."""
        model: NonlinearModel = self._import(self.loader)(path, data)
        return model

    def schema(self) -> type[BaseModel]:
        """Return the schema of the structure's parameter files."""
        schema: type[BaseModel] = self._import(self.file)
        return schema

    def finder(self) -> Finder:
        """Return the function that identifies the model; raise MissingPackageError if a dependency is missing."""
        if self.check:
            self._import(self.check)()
        finder: Finder = self._import(self.finder_function)
        return finder

    def _import(self, place: str) -> Any:  # noqa: ANN401 - objects of different types
        module, _, name = place.partition(":")
        return getattr(import_module(f"{self.package}.{module}"), name)


def function_structures() -> Mapping[str, FunctionStructure]:
    """Return all structures by the name in their parameter files, the simplest first."""
    return {
        structure.structure: structure
        for structure in sorted(plug_ins("structures"), key=lambda structure: structure.rank)
    }
