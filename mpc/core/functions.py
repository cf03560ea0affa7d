"""Functions of the user in C: terms and nonlinear models, generated and compiled like the shipped formulas."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.core.generate import generate
from diffdrive_mpc.mpc.core.library import load_functions
from diffdrive_mpc.mpc.problem.formulas import differentiated, term, term_symbols
from diffdrive_mpc.mpc.problem.terms import Term

CompiledTerm = tuple[Any, int, bool, int]
"""Address of the function, rows of its value, whether it is soft, and the place of its first parameter."""


def model_functions(model: NonlinearModel) -> tuple[ca.Function, ca.Function]:
    """Step and output of a nonlinear model with their gradients, as the core calls them."""
    inputs = {"x": ca.SX.sym("x", model.order), "window": ca.SX.sym("window", 2 * (model.memory + 1))}
    states = {"x": inputs["x"]}
    return (
        differentiated("ddmpc_user_step", inputs, "after", model.step(*inputs.values()), ("x", "window")),
        differentiated("ddmpc_user_output", states, "y", model.output(inputs["x"]), ("x",)),
    )


def term_function(index: int, own: Term) -> ca.Function:
    """A term with its gradient by pose, twist and command, as the core calls it; `index` tells it from the others."""
    inputs = term_symbols(own.parameters)
    given = [inputs[name] for name in own.function.name_in()]
    return term(f"ddmpc_user_term_{index}", inputs, own.function(*given))


def compile_functions(
    model: VelocityModel | NonlinearModel, terms: Sequence[Term]
) -> tuple[tuple[Any, Any] | None, list[CompiledTerm]]:
    """Addresses of a nonlinear model's step and output, if it is one, and of the terms.

    Raises
    ------
    NotCompiledError
        If there is something to compile, and no compiler.
    """
    functions = [*(model_functions(model) if isinstance(model, NonlinearModel) else ())]
    own = [term_function(index, term) for index, term in enumerate(terms)]
    if not functions and not own:
        return None, []
    addresses = load_functions(generate([*functions, *own], "ddmpc_user", "the user's functions"))
    step_and_output = (addresses[0], addresses[1]) if functions else None
    compiled: list[CompiledTerm] = []
    first = 0
    for address, term in zip(addresses[len(functions) :], terms, strict=True):
        compiled.append((address, term.rows, term.soft, first))
        first += term.parameters
    return step_and_output, compiled
