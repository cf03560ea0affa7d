"""Generation of C code from CasADi functions: C99 for double and single precision, without allocated memory.

CasADi generates the statements. Its macros, query functions and reference counts are omitted. Each constant and
function of math.h is wrapped, so that the same text is valid for both precisions, and single precision does not use
double arithmetic.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.core.library import load_core, load_functions
from diffdrive_mpc.mpc.problem.formulas import formulas, network_formulas
from diffdrive_mpc.mpc.problem.terms import Term, parameter_places
from diffdrive_mpc.mpc.problem.user_functions import user_output, user_step, user_term

_SIGNATURE = "int {name}(const real **arg, real **res, long long *iw, real *w, int mem)"

# Functions of math.h that CasADi may call.
_MATH = re.compile(
    "a?(?:cos|sin|tan)h?|atan2|ceil|copysign|erf|exp|expm1|fabs|floor|fmax|fmin|fmod|hypot|log|log1p|pow|remainder|sqrt"
)
_HELPERS = {
    "sq": "static inline real ddmpc_square(real x) { return x * x; }",
    "sign": "static inline real ddmpc_sign(real x) { return x < 0 ? -1 : x > 0 ? 1 : x; }",
}
_HELPER_NAMES = {"sq": "ddmpc_square", "sign": "ddmpc_sign"}
# Functions of real.h without calls, for loops that the compiler vectorises.
_INLINE_NAMES = {"tanh": "ddmpc_tanh"}
_CONSTANTS = {"inf": "(real)INFINITY", "nan": "(real)NAN"}

_BODY = re.compile(r"^/\* (?P<name>\w+):[^\n]*\*/\nstatic int casadi_f\d+\([^)]*\) \{\n(?P<body>.*?)^\}", re.M | re.S)
_WORK = re.compile(
    r"^CASADI_SYMBOL_EXPORT int (?P<name>\w+)_work\(.*?sz_iw = (?P<iw>\d+);.*?sz_w = (?P<w>\d+);", re.M | re.S
)
_TOKEN = re.compile(
    r"(?P<number>(?<![\w.])(?:\d+\.\d*(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+))|(?P<call>\b[a-z]\w*)(?=\()|\bcasadi_(?P<rest>\w+)"
)

_SOURCE_HEAD = """\
/* Generated from {origin}; do not edit. */
#include "{stem}.h"

/* A function of math.h for numbers of type real. */
#ifdef DDMPC_FLOAT
#define MATH(name) name##f
#else
#define MATH(name) name
#endif
"""

_HEADER = """\
/* Generated from {origin}; do not edit.
 *
 * Each function reads its arguments in order from `arg` and writes its results to `res`; matrices are in column-major
 * order. Results must not overlap arguments; a result that is not needed may be NULL. `iw`, `w` and `mem` are not used,
 * since no function needs memory. */
#ifndef {guard}
#define {guard}

#include "real.h"

{declarations}
#endif
"""


_INLINE_HEADER = """\
/* Generated from {origin}; do not edit.
 *
 * Functions for inner loops, in the form of ddmpc_formulas.h; the compiler vectorises the loops over them. */
#ifndef {guard}
#define {guard}

#include "real.h"

{definitions}
#endif
"""


@dataclass(frozen=True)
class GeneratedC:
    """Text of a C file and of its header.

    Attributes
    ----------
    stem
        Name of both files without suffix; the source includes the header by this name.
    source, header
        Text of the files. The header includes real.h, which defines `real`, `R(number)`, and DDMPC_FLOAT in single
        precision.
    names
        Names of the functions.
    """

    stem: str
    source: str
    header: str
    names: tuple[str, ...]


def generate_formulas() -> GeneratedC:
    """Generate C of the controller's formulas in `mpc/problem/formulas.py`."""
    return generate(formulas(), "ddmpc_formulas", "mpc/problem/formulas.py")


def generate_network_formulas() -> GeneratedC:
    """Generate C of the formulas of network units in `models/lstm_cell.py`."""
    return generate_inline(network_formulas(), "ddmpc_network_formulas", "models/lstm_cell.py")


def generate(functions: Sequence[ca.Function], stem: str, origin: str) -> GeneratedC:
    """Generate C of SX functions under their own names.

    Parameters
    ----------
    functions
        Functions to generate. Sparse results become dense.
    stem
        Name of the files without suffix.
    origin
        Source of the functions, for the comment at the head of the files.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a function needs an operation that C99 lacks, or needs memory.
    """
    bodies = _bodies(functions, {})
    parts = [_SOURCE_HEAD.format(origin=origin, stem=stem), *_helpers(bodies)]
    names = tuple(function.name() for function in functions)
    for name in names:
        signature = _SIGNATURE.format(name=name)
        parts.append(f"{signature}\n{{\n  (void)iw, (void)w, (void)mem;\n{bodies[name]}}}\n")
    declarations = "\n".join(f"{_shapes_of(f)}\n{_SIGNATURE.format(name=f.name())};\n" for f in functions)
    header = _HEADER.format(origin=origin, guard=f"{stem.upper()}_H", declarations=declarations)
    return GeneratedC(stem, "\n".join(parts), header, names)


def generate_inline(functions: Sequence[ca.Function], stem: str, origin: str) -> GeneratedC:
    """Generate a header with inline C definitions of SX functions for the inner loops of hand-written code.

    Raises
    ------
    models.checked_yaml.ConfigError
        As for `generate`.
    """
    bodies = _bodies(functions, _INLINE_NAMES)
    functions_text = (
        f"{_shapes_of(function)}\nstatic inline int {name}(const real **arg, real **res)\n{{\n{bodies[name]}}}\n"
        for function in functions
        for name in [function.name()]
    )
    definitions = "\n".join([*_helpers(bodies), *functions_text])
    header = _INLINE_HEADER.format(origin=origin, guard=f"{stem.upper()}_H", definitions=definitions)
    return GeneratedC(stem, "", header, tuple(function.name() for function in functions))


def _bodies(functions: Sequence[ca.Function], names: Mapping[str, str]) -> dict[str, str]:
    """Return CasADi's statements of each function by name, with calls of math.h replaced as in `names`."""
    generator = ca.CodeGenerator("text.c", {"with_header": False, "main": False, "mex": False, "with_mem": False})
    for function in functions:
        generator.add(_without_repetitions(function))
    text = generator.dump()
    for match in _WORK.finditer(text):
        # The core passes no work memory to the functions.
        if (match["iw"], match["w"]) != ("0", "0"):
            raise ConfigError(f"{match['name']}: its C code needs memory; write it without calls of other functions")
    bodies = {match["name"]: _plain(match["name"], match["body"], names) for match in _BODY.finditer(text)}
    for function in functions:
        if function.name() not in bodies:
            version = ca.CasadiMeta.version()
            raise ConfigError(f"{function.name()}: cannot parse the C code of CasADi {version}; install 3.8")
    return bodies


def _helpers(bodies: Mapping[str, str]) -> list[str]:
    """Return definitions of functions that the statements call and that are missing in C99."""
    return [f"{line}\n" for name, line in _HELPERS.items() if _HELPER_NAMES[name] in "".join(bodies.values())]


def _without_repetitions(function: ca.Function) -> ca.Function:
    """Return `function` with dense results and without repeated computations."""
    symbols = function.sx_in()
    results = ca.cse([ca.densify(result) for result in function.call(symbols, True, False)])
    return ca.Function(function.name(), symbols, results, function.name_in(), function.name_out())


def _plain(name: str, body: str, names: Mapping[str, str]) -> str:
    """Convert CasADi's statements to the precision of `real`, including numbers and functions of math.h."""

    def replacement(token: re.Match[str]) -> str:
        # A constant without this macro would have the type double, also in single precision.
        if token["number"]:
            return f"R({token['number']})"
        word = token["rest"] or token["call"]
        called = token["call"] is not None
        word = word.removeprefix("casadi_")
        if not called and word == "real":
            return "real"
        if not called and word in _CONSTANTS:
            return _CONSTANTS[word]
        if called and word in names:
            return names[word]
        if called and word in _HELPER_NAMES:
            return _HELPER_NAMES[word]
        if called and _MATH.fullmatch(word):
            return f"MATH({word})"
        if called and word == "if":
            return word
        raise ConfigError(f"{name}: CasADi's operation '{word}' has no form in C99; write the function without it")

    return _TOKEN.sub(replacement, body)


def _shapes_of(function: ca.Function) -> str:
    arguments = ", ".join(_shapes(function.name_in(k), function.size_in(k)) for k in range(function.n_in()))
    results = ", ".join(_shapes(function.name_out(k), function.size_out(k)) for k in range(function.n_out()))
    return f"/* ({arguments}) to ({results}) */"


def _shapes(name: str, shape: tuple[int, int]) -> str:
    rows, columns = shape
    return f"{name} {rows}" if columns == 1 else f"{name} {rows} x {columns}"


CompiledTerm = tuple[Any, int, bool, int]
"""Address of the function, rows of its value, True if it is soft, and index of its first parameter."""

STEP, OUTPUT = "ddmpc_user_step", "ddmpc_user_output"
"""Names of a nonlinear model's functions in C."""


def term_name(index: int) -> str:
    """Return the C name of the term with this index."""
    return f"ddmpc_user_term_{index}"


def generated_functions(model: VelocityModel | NonlinearModel, terms: Sequence[Term]) -> GeneratedC | None:
    """Generate C of the user's nonlinear model and terms; return None if there are none.

    Raises
    ------
    ConfigError
        If a function cannot be written as C.
    """
    functions: list[ca.Function] = []
    if isinstance(model, NonlinearModel) and model.compiled_step is None:
        functions += [user_step(model.step, STEP), user_output(model.output, OUTPUT, model.order)]
    functions += [
        user_term(term.function, term_name(index)) for index, term in enumerate(terms) if term.compiled is None
    ]
    if not functions:
        return None
    return generate(functions, "ddmpc_user", "the user's functions")


def compile_functions(
    model: VelocityModel | NonlinearModel, terms: Sequence[Term]
) -> tuple[tuple[Any, Any] | None, list[CompiledTerm]]:
    """Return the addresses of a nonlinear model's step and output (None for a linear model), and the compiled terms.

    Raises
    ------
    ConfigError
        If a function cannot be written as C.
    ModelError
        If the model is a network that the core does not support.
    NotCompiledError
        If functions have to be compiled, and no compiler is found.
    """
    ffi, core = load_core()
    generated = generated_functions(model, terms)
    compiled = model.compiled_step if isinstance(model, NonlinearModel) else None
    library = load_functions(generated) if generated else None

    def address(name: str) -> Any:  # noqa: ANN401 - cffi has no types
        return ffi.addressof(library, name)

    step_and_output = None
    if compiled is not None:
        step_and_output = ffi.addressof(core, compiled.step), ffi.addressof(core, compiled.output)
    elif isinstance(model, NonlinearModel):
        step_and_output = address(STEP), address(OUTPUT)
    places = parameter_places(terms)

    def term_address(index: int, term: Term) -> Any:  # noqa: ANN401 - cffi has no types
        return address(term_name(index)) if term.compiled is None else term.compiled

    return step_and_output, [
        (term_address(index, term), term.rows, term.soft, places[term.name].start) for index, term in enumerate(terms)
    ]
