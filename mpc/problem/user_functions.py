"""Conversion of user-defined functions to the form of the built-in formulas, with named inputs and gradients.

A user-defined function is a term (a least-squares residual or a soft-limited value), or the step or the output of a
nonlinear velocity model.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping

import casadi as ca

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc.problem.formulas import TERM_INPUTS, differentiate, named_function, term, term_symbols

_C_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)


def user_term(function: ca.Function, name: str, where: str | None = None) -> ca.Function:
    """Wrap a user-defined `function` as a term with the C name `name`.

    Parameters
    ----------
    function
        Function with any of the inputs pose (3), twist (2), command (2), reference (4), parameters (p), in any order,
        and one column (m) as output. Units and frames are those of `mpc.problem.formulas`.
    name
        Name of the C function.
    where
        Name for messages; by default "term" and the name of the function.

    Returns
    -------
    casadi.Function
        Function of pose, twist, command, reference, parameters (p, possibly 0) with the outputs `value` (m) and
        `gradient` (m x 7) by pose, twist and command.

    Raises
    ------
    ConfigError
        If the function has other inputs or outputs, depends on free variables, or cannot be converted to C.
    """
    where = _checked_function(function, name, "term", where)
    known_inputs = (*TERM_INPUTS, "parameters")
    columns = _input_lengths(function, where)
    for input_name, length in columns.items():
        if input_name not in known_inputs:
            near = difflib.get_close_matches(input_name, known_inputs, 1) or known_inputs
            raise ConfigError(f"{where}: unknown input '{input_name}'; rename it to {' or '.join(near)}")
        if length != TERM_INPUTS.get(input_name, length):
            raise ConfigError(f"{where}: input '{input_name}' has {length} entries; it needs {TERM_INPUTS[input_name]}")
    _output_length(function, where)
    inputs = term_symbols(columns.get("parameters", 0))
    return term(name, inputs, _value(function, [inputs[input_name] for input_name in columns], where))


def user_step(function: ca.Function, name: str) -> ca.Function:
    """Wrap the step of a user-defined nonlinear velocity model as a function with the C name `name`.

    Parameters
    ----------
    function
        Function of the state `x` (n) and of `window` (2 W) that returns the state (n) one sample later. `window`
        contains the commands v_ref [m/s], omega_ref [rad/s] of the last W samples, oldest first.
    name
        Name of the C function.

    Returns
    -------
    casadi.Function
        Function of the same inputs with the outputs `x_next` (n), `by_x` (n x n) and `by_window` (n x 2 W).

    Raises
    ------
    ConfigError
        If the function is invalid for the reasons of `user_term`, the length of the state changes, or the length of the
        window is odd or zero.
    """
    where = _checked_function(function, name, "step")
    columns = _input_lengths(function, where)
    if set(columns) != {"x", "window"}:
        raise ConfigError(f"{where}: its inputs are {', '.join(columns)}; they must be x and window")
    if columns["window"] == 0 or columns["window"] % 2:
        raise ConfigError(f"{where}: window has {columns['window']} entries; it needs two per command")
    if _output_length(function, where) != columns["x"]:
        raise ConfigError(f"{where}: the state after a step has {function.numel_out(0)} entries, x has {columns['x']}")
    symbols = {input_name: ca.SX.sym(input_name, length) for input_name, length in columns.items()}
    inputs = {"x": symbols["x"], "window": symbols["window"]}
    x_next = _value(function, list(symbols.values()), where)
    gradients = {f"by_{input_name}": ca.jacobian(x_next, symbol) for input_name, symbol in inputs.items()}
    return named_function(name, inputs, {"x_next": x_next, **gradients})


def user_output(function: ca.Function, name: str, states: int) -> ca.Function:
    """Wrap the output of a user-defined nonlinear velocity model as a function with the C name `name`.

    Parameters
    ----------
    function
        Function of the state `x` (n) that returns v [m/s], omega [rad/s] (2).
    name
        Name of the C function.
    states
        Number n of states.

    Returns
    -------
    casadi.Function
        Function of the same input with the outputs `y` (2) and `gradient` (2 x n).

    Raises
    ------
    ConfigError
        If the function is invalid for the reasons of `user_term`, its input does not have `states` entries, or its
        output does not have two entries.
    """
    where = _checked_function(function, name, "output")
    if _input_lengths(function, where) != {"x": states}:
        raise ConfigError(f"{where}: its only input must be x, with {states} entries as in the step")
    if _output_length(function, where) != 2:
        raise ConfigError(f"{where}: it has {function.numel_out(0)} entries; it needs two, v and omega")
    inputs = {"x": ca.SX.sym("x", states)}
    return differentiate(name, inputs, "y", _value(function, list(inputs.values()), where), ("x",))


def _checked_function(function: ca.Function, name: str, kind: str, where: str | None = None) -> str:
    """Check that `function` is a CasADi function and `name` a valid C name; return the name for messages."""
    if not isinstance(function, ca.Function):
        raise ConfigError(
            f"{where or f'{kind} {name}'}: {type(function).__name__} is not a casadi.Function; build one with named "
            "inputs"
        )
    if not _C_NAME.fullmatch(name):
        raise ConfigError(f"{kind} '{name}': use letters, digits and underscores only")
    where = where or f"{kind} {function.name()}"
    if function.has_free():
        raise ConfigError(f"{where}: it depends on {', '.join(map(str, function.get_free()))}; add them as inputs")
    return where


def _input_lengths(function: ca.Function, where: str) -> Mapping[str, int]:
    for k in range(function.n_in()):
        if function.size2_in(k) > 1:
            raise ConfigError(f"{where}: input '{function.name_in(k)}' is a matrix; make it a column")
    return {function.name_in(k): function.numel_in(k) for k in range(function.n_in())}


def _output_length(function: ca.Function, where: str) -> int:
    if function.n_out() != 1:
        raise ConfigError(f"{where}: it has {function.n_out()} outputs; stack them to a column")
    if function.size2_out(0) != 1 or function.size1_out(0) == 0:
        raise ConfigError(f"{where}: its output is {function.size1_out(0)} x {function.size2_out(0)}; make it a column")
    return int(function.size1_out(0))


def _value(function: ca.Function, arguments: list[ca.SX], where: str) -> ca.SX:
    """Expand the function to elementary operations, and evaluate it with symbols."""
    expansion_error = ConfigError(
        f"{where}: CasADi cannot expand it to elementary operations; use SX, and do not call solvers or tables"
    )
    try:
        expanded = function.expand()
    except RuntimeError as error:
        raise expansion_error from error
    # The expansion keeps calls of some functions, whose C code would need memory.
    if any(expanded.instruction_id(k) == ca.OP_CALL for k in range(expanded.n_instructions())):
        raise expansion_error
    return expanded.call(arguments, True, False)[0]
