"""Terms of the user: residuals that are squared and added to the cost, and values with soft limits.

A term is one CasADi function of what the plan does at a sample. It is differentiated, generated as C and compiled like the
shipped ones.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc.config.schema import TermConfig
from diffdrive_mpc.mpc.problem.formulas import TERM_INPUTS

MOST_SOFT_ROWS = 24
"""Rows of soft limits that all terms may have together at a sample."""
_NO_LIMIT = 1e14


@dataclass(frozen=True)
class Term:
    """A function of the plan at each of the samples 1 to N.

    Attributes
    ----------
    name
        Name for messages and tables.
    function
        CasADi function of some of `pose` (3) [m, m, rad], `twist` (2) of the body [m/s, rad/s], `command` (2) before the
        sample, `reference` (4): x, y [m], theta [rad] to aim at and the heading [rad] to hold there, and `parameters` (p);
        inputs go by name. Its only output is the value (m).
    kind
        "residual": half the value's square is added to the cost, so a weight w enters as its root; "soft": the value is
        kept between `lower` and `upper` (m,), at the price of the shipped soft limits (`weights.soft`).
    defaults
        (p,) stage parameters until others are set.
    """

    name: str
    function: ca.Function
    kind: Literal["residual", "soft"] = "residual"
    upper: ArrayLike | None = None
    lower: ArrayLike | None = None
    defaults: Sequence[float] = ()

    def __post_init__(self) -> None:
        """Check names and shapes, and fill in limits that are not given."""
        function, where = self.function, f"term '{self.name}'"
        known = {**TERM_INPUTS, "parameters": len(self.defaults)}
        for index, name in enumerate(function.name_in()):
            if name not in known:
                raise ConfigError(f"{where}: unknown input '{name}'; known inputs: {', '.join(known)}")
            if function.size1_in(index) != known[name] or function.size2_in(index) != 1:
                raise ConfigError(
                    f"{where}: input '{name}' has {function.numel_in(index)} numbers, expected {known[name]}"
                )
        if function.n_out() != 1 or function.size2_out(0) != 1:
            raise ConfigError(f"{where}: give one output, a column of values")
        limits = {"upper": (self.upper, _NO_LIMIT), "lower": (self.lower, -_NO_LIMIT)}
        for name, (given, default) in limits.items():
            if given is not None and not self.soft:
                raise ConfigError(f"{where}: {name} is for kind soft; a residual has no limits")
            values = np.full(self.rows, default) if given is None else np.atleast_1d(np.asarray(given, dtype=float))
            if values.shape != (self.rows,):
                raise ConfigError(f"{where}: {name} has {values.size} numbers, expected {self.rows}")
            object.__setattr__(self, name, np.clip(values, -_NO_LIMIT, _NO_LIMIT))

    @property
    def soft(self) -> bool:
        """Whether its value is limited."""
        return self.kind == "soft"

    @property
    def rows(self) -> int:
        """Length m of its value."""
        return int(self.function.size1_out(0))

    @property
    def parameters(self) -> int:
        """Number p of its stage parameters."""
        return len(self.defaults)


def load_terms(configs: Sequence[TermConfig]) -> tuple[Term, ...]:
    """Terms that a configuration names. Runs their files.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a file cannot be run, has no such function, or that is none of (pose, twist, command, ...).
    """
    return tuple(_load(config) for config in configs)


def _load(config: TermConfig) -> Term:
    path = Path(config.file)
    function = getattr(_run(path), config.function, None)
    if not isinstance(function, ca.Function):
        raise ConfigError(
            f"{path}: '{config.function}' is no CasADi function there; give the name of a casadi.Function"
        )
    return Term(config.function, function, config.kind, config.upper, config.lower, tuple(config.parameters))


def _run(path: Path) -> object:
    spec = importlib.util.spec_from_file_location(f"diffdrive_mpc_term_{path.stem}", path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise ConfigError(f"{path}: there is no such Python file; a term names the file of its function")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise ConfigError(f"{path}: {type(error).__name__}: {error}") from error
    return module
