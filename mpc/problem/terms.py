"""Terms of the user: residuals that are squared and added to the cost, and values with soft limits.

A term is one CasADi function of the plan's values at a sample. It is differentiated, generated as C and compiled like
the shipped ones.
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

MOST_SOFT_ROWS = 24
"""Rows of soft limits that all terms may have together at a sample."""

Limits = Sequence[float | None] | float | None
"""Limits of a value, row by row; None: no limit."""

_KINDS = ("residual", "soft")
_NO_LIMIT = 1e14


@dataclass(frozen=True, eq=False)
class Term:
    """A function of the plan at each of the samples 1 to N.

    Attributes
    ----------
    name
        Name for messages and for `Controller.set_parameters`.
    function
        CasADi function of some of `pose` (3) [m, m, rad] in the frame of the reference, `twist` (2) of the body
        [m/s, rad/s], `command` (2) before the sample [m/s, rad/s], `reference` (4): x, y [m], theta [rad] to aim at and
        the heading [rad] to hold there, and `parameters` (p); inputs go by name. Its only output is the value (m).
    kind
        "residual": half the value's square is added to the cost, so a weight w enters as its root; "soft": the value is
        kept between `lower` and `upper`. One unit beyond them costs `weights.soft`, and half its square
        `weights.soft_quadratic`, so scaling a value up makes its limit stricter.
    upper, lower
        (m,) limits of a soft term; None, for all of it or in a row: no limit.
    defaults
        (p,) stage parameters until others are set.
    compiled
        Address of the function in a loaded library, a cffi pointer; None if it is compiled for the controller.

    Raises
    ------
    ConfigError
        If any of these does not fit. The message is one line: term, mistake, remedy.
    """

    name: str
    function: ca.Function
    kind: Literal["residual", "soft"] = "residual"
    upper: Limits = None
    lower: Limits = None
    defaults: Sequence[float] = ()
    compiled: Any = field(default=None, repr=False)
    bounds: FloatArray = field(init=False, repr=False)
    """(2, m) lower and upper limits as numbers, of a residual too."""

    def __post_init__(self) -> None:
        """Check all of it."""
        where = f"term '{self.name}'"
        if self.kind not in _KINDS:
            raise ConfigError(f"{where}: unknown kind '{self.kind}'; give {' or '.join(_KINDS)}")
        compiled = user_term(self.function, "ddmpc_user_term", where)
        if compiled.nnz_out("gradient") == 0:
            raise ConfigError(f"{where}: its value depends on none of pose, twist and command; no plan could change it")
        taken = compiled.numel_in("parameters")
        if taken != len(self.defaults):
            raise ConfigError(
                f"{where}: its function takes {taken} parameters, and {len(self.defaults)} are given; give as many"
            )
        if not all(_is_number(value) for value in self.defaults):
            raise ConfigError(f"{where}: parameters {list(self.defaults)}; give finite numbers")
        if self.soft and self.upper is None and self.lower is None:
            raise ConfigError(f"{where}: kind soft, but no limit; give upper or lower, or make it a residual")
        bounds = np.stack([self._limits("lower", self.lower, -_NO_LIMIT), self._limits("upper", self.upper, _NO_LIMIT)])
        for row, (low, high) in enumerate(bounds.T):
            if low > high:
                raise ConfigError(f"{where}: lower {low:g} is above upper {high:g} in row {row}; swap them")
        bounds.flags.writeable = False
        object.__setattr__(self, "bounds", bounds)

    def _limits(self, name: str, limits: Limits, none: float) -> FloatArray:
        """Return one side of the limits (m,)."""
        where = f"term '{self.name}'"
        if limits is not None and not self.soft:
            raise ConfigError(f"{where}: {name} is for kind soft; a residual has no limits, leave it out")
        rows = [limits] * self.rows if limits is None else [limits] if isinstance(limits, float | int) else list(limits)
        if len(rows) != self.rows:
            raise ConfigError(f"{where}: {name} has {len(rows)} numbers, its value has {self.rows}; give one for each")
        if not all(row is None or _is_number(row) for row in rows):
            raise ConfigError(f"{where}: {name} {rows} contains a value that is not finite; for no limit give none")
        return np.array([none if row is None else row for row in rows], dtype=float)

    @property
    def soft(self) -> bool:
        """True if the value of the term is limited."""
        return self.kind == "soft"

    @property
    def rows(self) -> int:
        """Length m of its value."""
        return int(self.function.size1_out(0))

    @property
    def parameters(self) -> int:
        """Number p of its stage parameters."""
        return len(self.defaults)


def checked_terms(terms: object) -> tuple[Term, ...]:
    """Return `terms` as a tuple; raise ArgumentError if they are no list of terms."""
    if isinstance(terms, (list, tuple)) and all(isinstance(term, Term) for term in terms):
        return tuple(terms)
    remedy = "write terms=[term], where term = Term(name, casadi.Function(...))"
    odd = terms
    if isinstance(terms, (list, tuple)):
        odd = next(term for term in terms if not isinstance(term, Term))
    raise wrong_type("terms", "a list of Term", odd, remedy)


def all_terms(configs: Sequence[TermConfig], given_terms: Sequence[Term]) -> tuple[Term, ...]:
    """Combine terms from configured files, which are run, with terms passed in Python, in this order.

    Raises
    ------
    ConfigError
        If a file cannot be run, has no such function, or that is none of (pose, twist, command, ...); if two terms have
        one name, or all of them together more rows of soft limits than a controller holds.
    """
    terms = (*(_load(config) for config in configs), *given_terms)
    for name, count in Counter(entry.name for entry in terms).items():
        if count > 1:
            raise ConfigError(f"term '{name}': {count} terms have this name; give each its own name")
    soft = [entry for entry in terms if entry.soft]
    rows = sum(entry.rows for entry in soft)
    if rows > MOST_SOFT_ROWS:
        each = ", ".join(f"{entry.name} {entry.rows}" for entry in soft)
        raise ConfigError(
            f"terms with soft limits have {rows} rows together ({each}), at most {MOST_SOFT_ROWS} are held; leave some "
            "out, or make them residuals"
        )
    return terms


def parameter_places(terms: Sequence[Term]) -> dict[str, slice]:
    """Return the places of each term's parameters among those of all terms, by name."""
    ends = list(accumulate((term.parameters for term in terms), initial=0))
    return {term.name: slice(first, end) for term, (first, end) in zip(terms, pairwise(ends), strict=True)}


def checked_parameters(
    terms: Sequence[Term], samples: int, values: Mapping[str, ArrayLike]
) -> list[tuple[slice, FloatArray]]:
    """Check stage parameters by name of their term, (p,) or (samples, p); return their places and numbers.

    Raises
    ------
    ConfigError
        If there is no such term, or the shape is not one of these, or a value is not finite.
    """
    places, checked = parameter_places(terms), []
    for name, value in values.items():
        where = f"term '{name}'"
        if name not in places:
            raise ConfigError(f"{where}: there is none; there are: {', '.join(places) or 'no terms'}")
        p = places[name].stop - places[name].start
        try:
            rows = np.asarray(value, dtype=float)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"{where}: its parameters are no numbers") from error
        if rows.shape not in ((p,), (samples, p)):
            raise ConfigError(f"{where}: give {p} parameters, or {samples} rows of them (found shape {rows.shape})")
        if not np.isfinite(rows).all():
            raise ConfigError(f"{where}: its parameters contain a value that is not finite")
        checked.append((places[name], rows))
    return checked


def _load(config: TermConfig) -> Term:
    path, name = Path(config.file), config.name or config.function
    module = _run(path)
    functions = {key: value for key, value in module.items() if isinstance(value, ca.Function)}
    if config.function not in functions:
        defined = f"there are: {', '.join(functions)}" if functions else "it defines none"
        raise ConfigError(f"{path}: term '{name}': no casadi.Function '{config.function}' in that file; {defined}")
    try:
        return Term(name, functions[config.function], config.kind, config.upper, config.lower, tuple(config.parameters))
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _run(path: Path) -> dict[str, object]:
    """Run a Python file and return its globals."""
    check_trusted(path)
    spec = importlib.util.spec_from_file_location(f"diffdrive_mpc_term_{path.stem}", path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise ConfigError(
            f"{path}: no such Python file; a term names the file of its function, seen from the configuration's folder"
        )
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except KeyboardInterrupt:
        raise  # the user's own, while the file ran
    except BaseException as error:  # SystemExit, too: a file must not end the program in the user's name
        message = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
        raise ConfigError(f"{path}: running it ends with {message}") from error
    return vars(module)


def _is_number(value: object) -> bool:
    return isinstance(value, float | int | np.integer | np.floating) and math.isfinite(value)
