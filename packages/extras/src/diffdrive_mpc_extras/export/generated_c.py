"""Generated C files of one controller: ddmpc_sizes.h, constants.c and trajectory.[ch]."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import numpy as np

from diffdrive_mpc import Term
from diffdrive_mpc.core_sources import (
    HARD_KINDS,
    OUTPUT,
    STEP,
    Problem,
    constant_fields,
    load_core,
    parameter_places,
    term_name,
)
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.table import plain_line
from diffdrive_mpc.mpc.trajectories.native import NativeTrajectory
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory


def sizes_text(problem: Problem, *, is_single: bool) -> str:
    """Format ddmpc_sizes.h, which defines the sizes and the memory of the core."""
    ffi, lib = load_core()
    sizes = _sizes(problem)
    c_sizes = ffi.new("ddmpc_sizes *", sizes)
    memory = {"reals": lib.ddmpc_reals(c_sizes), "ints": lib.ddmpc_ints(c_sizes)}
    starts = {name: span.start for name, span in parameter_places(problem.terms).items()}
    offsets = {f"first_parameter_of_{_identifier(name)}": start for name, start in starts.items()}
    lines = [f"#define DDMPC_{name.upper()} {value}" for name, value in {**sizes, **memory, **offsets}.items()]
    guard = ["#ifndef DDMPC_SIZES_H", "#define DDMPC_SIZES_H", "", "#define DDMPC_EXPORT"]
    return "\n".join([*guard, *(["#define DDMPC_FLOAT"] if is_single else []), *lines, "", "#endif", ""])


def operations_bound(problem: Problem) -> int:
    """Compute an upper bound of the active-set operations per tick of the exported controller."""
    _, lib = load_core()
    sizes = _sizes(problem)
    return int(lib.ddmpc_operations_bound(sizes["steps"], HARD_KINDS + sizes["soft"], sizes["max_active"]))


def _sizes(problem: Problem) -> dict[str, int]:
    """Return the sizes of the problem with fewer active limits, whose rows need most of the memory."""
    return problem.sizes | {"max_active": 2 * problem.config.horizon + 32}


def constants_text(problem: Problem, functions: str | None) -> str:
    """Format constants.c; `functions` is the stem of the file with the user's functions, or None."""
    tables, constants = [], []
    for name, value in constant_fields(_sizes(problem), problem.constants()):
        if not isinstance(value, np.ndarray):
            constants.append((name, _c_value(value)))
        elif value.size:
            tables.append(_table("real", name, value.ravel()))
            constants.append((name, name))
        else:  # C has no empty arrays
            constants.append((name, "0"))
    sizes = [(name, str(value)) for name, value in _sizes(problem).items()]
    slices = parameter_places(problem.terms)
    terms = ",\n".join(_term(index, term, slices[term.name].start) for index, term in enumerate(problem.terms))
    step, output = (STEP, OUTPUT) if problem.prediction is None else ("0", "0")
    if problem.compiled_step is not None:
        step, output = problem.compiled_step.step, problem.compiled_step.output
    members = [("step", step), ("output", output)]
    defaults = np.array([value for term in problem.terms for value in term.defaults])
    return "\n\n".join(
        [
            '#include "ddmpc.h"' + (f'\n#include "{functions}.h"' if functions else ""),
            *tables,
            *([f"static const ddmpc_term terms[] = {{\n{terms}\n}};"] if terms else []),
            _struct("ddmpc_sizes", "sizes", sizes),
            _struct("ddmpc_constants", "constants", constants),
            _struct("ddmpc_functions", "functions", [*members, ("terms", "terms" if terms else "0")]),
            _table("real", "ddmpc_this_defaults", defaults if defaults.size else np.zeros(1), static=""),
            "",
        ]
    )


def trajectory_texts(reference: Reference, spacing: float) -> dict[str, str]:
    """Format trajectory.[ch]: `reference` in closed form if it has one, or else cubic pieces of `spacing` [s].

    Raises
    ------
    ValueError
        If the reference is not finite at a sample.
    """
    closed_form = _closed_form(reference, spacing)
    name = f"ddmpc_{_identifier(reference.name)}"
    members = [
        ("breaks", "breaks"),
        ("table", "table"),
        ("pieces", str(closed_form.table.shape[1])),
        ("cubic", str(int(len(closed_form.table) == 16))),
        ("duration", _c_number(reference.duration)),
        ("motion", _c_value(closed_form.motion.tolist())),
    ]
    parts = [
        '#include "trajectory.h"',
        _table("ddmpc_time", "breaks", closed_form.breaks),
        _table("real", "table", closed_form.table.ravel()),
        f"const ddmpc_trajectory {name} = {{\n{_members(members)}\n}};",
        "",
    ]
    header = (
        "#ifndef DDMPC_TRAJECTORY_H\n#define DDMPC_TRAJECTORY_H\n\n"
        '#include "core.h"\n\n'
        f"/* {_comment(reference.name)} */\n"
        f"extern const ddmpc_trajectory {name};\n#define DDMPC_TRAJECTORY {name}\n\n#endif\n"
    )
    return {"trajectory.c": "\n\n".join(parts), "trajectory.h": header}


def _closed_form(reference: Reference, spacing: float) -> NativeTrajectory:
    native = getattr(reference, "native", None)
    if isinstance(native, NativeTrajectory):
        return native
    times = np.linspace(0.0, reference.duration, max(2, int(np.ceil(reference.duration / spacing - 1e-9)) + 1))
    sample = reference.sample(times)
    is_finite = np.isfinite(np.hstack([sample.pose, sample.twist])).all(axis=1)
    if not is_finite.all():
        raise ValueError(f"reference '{reference.name}' is not finite at {times[is_finite.argmin()]:.2f} s; repair it")
    v, heading = sample.twist[:, :1], sample.pose[:, 2:]
    rates = np.hstack([v * np.cos(heading), v * np.sin(heading), sample.twist[:, 1:]])
    return SplineTrajectory.through(reference.name, times, sample.pose, rates).native


def _term(index: int, term: Term, first: int) -> str:
    members = {"function": term_name(index), "rows": term.rows, "soft": int(term.soft), "first_parameter": first}
    return "    {" + ", ".join(f".{name} = {value}" for name, value in members.items()) + "}"


def _struct(c_type: str, name: str, members: Iterable[tuple[str, str]]) -> str:
    return f"const {c_type} ddmpc_this_{name} = {{\n{_members(members)}\n}};"


def _members(members: Iterable[tuple[str, str]]) -> str:
    return ",\n".join(f"    .{name} = {value}" for name, value in members)


def _table(c_type: str, name: str, numbers: FloatArray, *, static: str = "static ") -> str:
    """Format a C array of decimals, which the compiler rounds to the precision of `c_type`."""
    decimals = [_c_number(value) for value in numbers.tolist()]
    lines = [", ".join(decimals[start : start + 8]) for start in range(0, len(decimals), 8)]
    return f"{static}const {c_type} {name}[] = {{\n    " + ",\n    ".join(lines) + "\n};"


def _c_value(value: Sequence[float] | float | int) -> str:
    if isinstance(value, Sequence):
        return "{" + ", ".join(_c_number(number) for number in value) + "}"
    return str(value) if isinstance(value, int) else _c_number(value)


def _c_number(value: float) -> str:
    if np.isnan(value):
        raise ValueError("a constant is not a number")
    return repr(float(value)) if np.isfinite(value) else f"{'-' if value < 0 else ''}INFINITY"


def _comment(text: str) -> str:
    """Replace in `text` the end of a comment, line continuations and characters that compilers warn about."""
    return re.sub(r"[*/\\?]", "_", plain_line(text, max_length=80))


def _identifier(name: str) -> str:
    return re.sub(r"\W", "_", name, flags=re.ASCII).lower() or "trajectory"
