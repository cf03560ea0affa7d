"""Functions of the user in C: terms and nonlinear models, generated and compiled like the shipped formulas."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import casadi as ca

from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.core.library import load_core, load_functions
from diffdrive_mpc.mpc.problem.terms import Term, parameter_places
from diffdrive_mpc.mpc.problem.user_functions import user_output, user_step, user_term

if TYPE_CHECKING:
    from diffdrive_mpc.mpc.core.generate import GeneratedC

CompiledTerm = tuple[Any, int, bool, int]
"""Address of the function, rows of its value, whether it is soft, and the place of its first parameter."""

STEP, OUTPUT = "ddmpc_user_step", "ddmpc_user_output"
"""Names of a nonlinear model's functions in C."""


def term_name(index: int) -> str:
    """Name in C of the term with this index."""
    return f"ddmpc_user_term_{index}"


def generated_functions(model: VelocityModel | NonlinearModel, terms: Sequence[Term]) -> GeneratedC | None:
    """C of the user's nonlinear model, if it is one, and of the terms; None if there is nothing to write.

    Raises
    ------
    ConfigError
        If a function cannot be written as C.
    """
    functions: list[ca.Function] = []
    if isinstance(model, NonlinearModel) and model.compiled_step is None:
        functions += [user_step(model.step, STEP), user_output(model.output, OUTPUT, model.order)]
    functions += [
        user_term(term.function, term_name(index)) for index, term in enumerate(terms) if not _symbol_of(term)
    ]
    if not functions:
        return None
    from diffdrive_mpc.mpc.core.generate import generate  # noqa: PLC0415 - most controllers bring no function

    return generate(functions, "ddmpc_user", "the user's functions")


def compile_functions(
    model: VelocityModel | NonlinearModel, terms: Sequence[Term]
) -> tuple[tuple[Any, Any] | None, list[CompiledTerm]]:
    """Addresses of a nonlinear model's step and output, if it is one, and of the terms.

    Raises
    ------
    ConfigError
        If a function cannot be written as C.
    ModelError
        If the model is a network that the core does not have.
    NotCompiledError
        If there is something to compile, and no compiler.
    """
    ffi, core = load_core()
    generated = generated_functions(model, terms)
    own = model.compiled_step if isinstance(model, NonlinearModel) else None
    library = load_functions(generated) if generated else None

    def address(name: str) -> Any:  # noqa: ANN401 - cffi has no types
        return ffi.addressof(library, name)

    step_and_output = None
    if own is not None:
        step_and_output = ffi.addressof(core, own.step), ffi.addressof(core, own.output)
    elif isinstance(model, NonlinearModel):
        step_and_output = address(STEP), address(OUTPUT)
    places = parameter_places(terms)

    def of_term(index: int, term: Term) -> Any:  # noqa: ANN401 - cffi has no types
        symbol = _symbol_of(term)
        return ffi.addressof(core, symbol) if symbol else address(term_name(index))

    return step_and_output, [
        (of_term(index, term), term.rows, term.soft, places[term.name].start) for index, term in enumerate(terms)
    ]


def _symbol_of(term: Term) -> str:
    """Name of a shipped term's function in the core; empty for one of the user."""
    return str(getattr(term, "symbol", ""))
