"""User-defined terms: residuals of the least-squares cost, and values with soft limits.

A term is a CasADi function of the plan at one sample. Like the built-in terms, it is differentiated, converted to C
and compiled.
"""

from __future__ import annotations

import importlib.util
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.errors import wrong_type
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.trust import check_trusted
from diffdrive_mpc.mpc.config.schema import TermConfig
from diffdrive_mpc.mpc.problem.user_functions import user_term

MAX_SOFT_ROWS = 24
"""Maximum total number of soft-limit rows of all terms at one sample."""

Limits = Sequence[float | None] | float | None
"""Limits of a value, row by row; None for no limit."""

_KINDS = ("residual", "soft")
# The core requires upper limits of soft rows below DDMPC_LARGEST, 1e15.
_NO_LIMIT = 1e14


@dataclass(frozen=True, eq=False)
class Term:
    """Function of the plan that is evaluated at each of the samples 1 to N.

    Attributes
    ----------
    name
        Name for messages and for `Controller.set_parameters`.
    function
        CasADi function with one output, the value (m). Inputs are matched by name, and any of these may be used:
        `pose` (3) [m, m, rad] in the frame of the reference, `twist` (2) of the body [m/s, rad/s], `command` (2) before
        the sample [m/s, rad/s], `reference` (4) with x, y [m], theta [rad] and the target heading [rad], and
        `parameters` (p).
    kind
        "residual": half the square of the value is added to the cost; a residual of weight w is scaled by sqrt(w).
        "soft": the value is limited to the range from `lower` to `upper`; a violation e costs `weights.soft` e plus
        `weights.soft_quadratic` e^2 / 2, so a larger scale of the value makes its limit stricter.
    upper, lower
        (m,) limits of a soft term; None means no limit, for all rows or for one row.
    defaults
        (p,) initial stage parameters.
    compiled
        Address of the function in a loaded library, a cffi pointer; None if the controller must compile the function.

    Raises
    ------
    ConfigError
        If an attribute is invalid; the message is one line with the term, the mistake and the remedy.
    """

    name: str
    function: ca.Function
    kind: Literal["residual", "soft"] = "residual"
    upper: Limits = None
    lower: Limits = None
    defaults: Sequence[float] = ()
    compiled: Any = field(default=None, repr=False)
    bounds: FloatArray = field(init=False, repr=False)
    """(2, m) lower and upper limits; -1e14 and 1e14 for unlimited rows and for a residual."""

    def __post_init__(self) -> None:
        """Check all attributes."""
        where = f"term '{self.name}'"
        if self.kind not in _KINDS:
            raise ConfigError(f"{where}: unknown kind '{self.kind}'; give {' or '.join(_KINDS)}")
        compiled = user_term(self.function, "ddmpc_user_term", where)
        if compiled.nnz_out("gradient") == 0:
            raise ConfigError(f"{where}: its value does not depend on pose, twist or command; use at least one of them")
        expected = compiled.numel_in("parameters")
        if expected != len(self.defaults):
            raise ConfigError(
                f"{where}: its function has {expected} parameters, but {len(self.defaults)} defaults are given; give "
                "one default for each parameter"
            )
        if not all(_is_number(value) for value in self.defaults):
            raise ConfigError(f"{where}: parameters {list(self.defaults)}; give finite numbers")
        if self.soft and self.upper is None and self.lower is None:
            raise ConfigError(f"{where}: kind soft without a limit; give upper or lower, or use kind residual")
        bounds = np.stack([self._limits("lower", self.lower, -_NO_LIMIT), self._limits("upper", self.upper, _NO_LIMIT)])
        for row, (low, high) in enumerate(bounds.T):
            if low > high:
                raise ConfigError(f"{where}: lower {low:g} is above upper {high:g} in row {row}; swap them")
        bounds.flags.writeable = False
        object.__setattr__(self, "bounds", bounds)

    def _limits(self, name: str, limits: Limits, none: float) -> FloatArray:
        """Return the lower or upper limits (m,); `none` replaces missing limits."""
        where = f"term '{self.name}'"
        if limits is not None and not self.soft:
            raise ConfigError(f"{where}: {name} is for kind soft; remove it, since a residual has no limits")
        rows = [limits] * self.rows if limits is None else [limits] if isinstance(limits, float | int) else list(limits)
        if len(rows) != self.rows:
            raise ConfigError(f"{where}: {name} has {len(rows)} limits for {self.rows} rows; give one per row")
        if not all(row is None or _is_number(row) for row in rows):
            raise ConfigError(f"{where}: {name} {rows} contains a value that is not finite; use null for no limit")
        return np.array([none if row is None else row for row in rows], dtype=float)

    @property
    def soft(self) -> bool:
        """True if the value of the term is limited."""
        return self.kind == "soft"

    @property
    def rows(self) -> int:
        """Length m of the value."""
        return int(self.function.size1_out(0))

    @property
    def parameters(self) -> int:
        """Number p of stage parameters."""
        return len(self.defaults)


def checked_terms(terms: object) -> tuple[Term, ...]:
    """Return `terms` as a tuple; raise ArgumentError if the argument is not a list or tuple of terms."""
    if isinstance(terms, (list, tuple)) and all(isinstance(term, Term) for term in terms):
        return tuple(terms)
    remedy = "write terms=[term], where term = Term(name, casadi.Function(...))"
    invalid = terms
    if isinstance(terms, (list, tuple)):
        invalid = next(term for term in terms if not isinstance(term, Term))
    raise wrong_type("terms", "a list of Term", invalid, remedy)


def all_terms(configs: Sequence[TermConfig], python_terms: Sequence[Term]) -> tuple[Term, ...]:
    """Load the terms of configured files by executing the files, and append the terms that are passed in Python.

    Raises
    ------
    ConfigError
        If a file cannot be executed or lacks the function, a function has an unknown input, two terms have the same
        name, or the terms have more than `MAX_SOFT_ROWS` rows of soft limits in total.
    """
    terms = (*(_load(config) for config in configs), *python_terms)
    for name, count in Counter(entry.name for entry in terms).items():
        if count > 1:
            raise ConfigError(f"term '{name}': {count} terms have this name; give each term a unique name")
    soft = [entry for entry in terms if entry.soft]
    rows = sum(entry.rows for entry in soft)
    if rows > MAX_SOFT_ROWS:
        each = ", ".join(f"{entry.name} {entry.rows}" for entry in soft)
        raise ConfigError(
            f"terms with soft limits have {rows} rows in total ({each}), the maximum is {MAX_SOFT_ROWS}; remove terms, "
            "or use kind residual"
        )
    return terms


def parameter_places(terms: Sequence[Term]) -> dict[str, slice]:
    """Return the slice of each term in the vector of stage parameters, by term name."""
    ends = list(accumulate((term.parameters for term in terms), initial=0))
    return {term.name: slice(first, end) for term, (first, end) in zip(terms, pairwise(ends), strict=True)}


def checked_parameters(
    terms: Sequence[Term], samples: int, values: Mapping[str, ArrayLike]
) -> list[tuple[slice, FloatArray]]:
    """Check stage parameters, given as (p,) or (samples, p) by term name; return slice and values of each term.

    Raises
    ------
    ConfigError
        If a term does not exist, a shape is wrong, or a value is not finite.
    """
    slices, valid = parameter_places(terms), []
    for name, value in values.items():
        where = f"term '{name}'"
        if name not in slices:
            raise ConfigError(f"{where}: not found; there are: {', '.join(slices) or 'no terms'}")
        p = slices[name].stop - slices[name].start
        try:
            rows = np.asarray(value, dtype=float)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"{where}: its parameters are not numbers") from error
        if rows.shape not in ((p,), (samples, p)):
            raise ConfigError(f"{where}: give {p} parameters, or {samples} rows of them (found shape {rows.shape})")
        if not np.isfinite(rows).all():
            raise ConfigError(f"{where}: its parameters contain a value that is not finite; give finite numbers")
        valid.append((slices[name], rows))
    return valid


def _load(config: TermConfig) -> Term:
    path, name = Path(config.file), config.name or config.function
    module = _execute(path)
    functions = {key: value for key, value in module.items() if isinstance(value, ca.Function)}
    if config.function not in functions:
        defined = f"it defines: {', '.join(functions)}" if functions else "it defines no casadi.Function"
        raise ConfigError(f"{path}: term '{name}': no casadi.Function '{config.function}' in this file; {defined}")
    try:
        return Term(name, functions[config.function], config.kind, config.upper, config.lower, tuple(config.parameters))
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _execute(path: Path) -> dict[str, object]:
    """Execute a Python file and return its globals."""
    check_trusted(path)
    spec = importlib.util.spec_from_file_location(f"diffdrive_mpc_term_{path.stem}", path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise ConfigError(
            f"{path}: no such Python file; give the path of the term's file relative to the configuration's folder"
        )
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except KeyboardInterrupt:
        raise  # an interrupt by the user ends the program
    except BaseException as error:  # includes SystemExit: a term file must not end the program
        message = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
        raise ConfigError(f"{path}: its execution fails with {message}") from error
    return vars(module)


def _is_number(value: object) -> bool:
    return isinstance(value, float | int | np.integer | np.floating) and math.isfinite(value)
