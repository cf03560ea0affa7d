"""Sources of the core: C files of this folder, and Python files from which C code of the formulas is generated."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

from diffdrive_mpc.models.compiled.compiler import digest_of

CORE = Path(__file__).parent
"""Folder of the C files and headers."""

_HEADER = "core.h"
_PACKAGE = CORE.parents[1]
# Files from which a part of the C code is generated.
_FORMULAS = (
    "models/pose.py",
    "models/slip_laws.py",
    "models/lstm_cell.py",
    "mpc/problem/formulas.py",
    "mpc/problem/slip.py",
    "mpc/problem/terms.py",
    "mpc/core/generate.py",
)
SIZES = "ddmpc_sizes.h"
"""Name of the header with sizes and precision; empty for Python, which an export replaces."""
_SIZES = {SIZES: "/* double precision, and sizes at run time */\n"}

_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
_ONLY_CPP = re.compile(r"^[ \t]*#[ \t]*ifdef[ \t]+__cplusplus\b.*?^[ \t]*#[ \t]*endif[^\n]*$", re.DOTALL | re.MULTILINE)
_DIRECTIVE = re.compile(r"^[ \t]*#(?:[^\n]*\\\n)*[^\n]*$", re.MULTILINE)
_CONSTANT = re.compile(r"\s*#\s*define\s+\w+\s+\d+\s*")


def core_texts() -> dict[str, str]:
    """Return all C files and headers of the core by name, including generated formulas."""
    # Imported on demand, since code generation is not needed if a library is found.
    from diffdrive_mpc.mpc.core.generate import generate_formulas, generate_network_formulas  # noqa: PLC0415

    formulas, network = generate_formulas(), generate_network_formulas()
    generated = {f"{formulas.stem}.c": formulas.source, f"{formulas.stem}.h": formulas.header}
    return {**written_texts(), **generated, f"{network.stem}.h": network.header}


def written_texts() -> dict[str, str]:
    """Return the hand-written C files and headers by name."""
    return _SIZES | {path.name: path.read_text(encoding="utf-8") for path in sorted(CORE.glob("*.[ch]"))}


def shared_headers() -> dict[str, str]:
    """Return the headers that functions outside the core need for their compilation."""
    return _SIZES | {"real.h": (CORE / "real.h").read_text(encoding="utf-8")}


def core_origin() -> str:
    """Compute the digest of all sources of the library; the generated code is not needed for the digest."""
    written = [part for item in written_texts().items() for part in item]
    return digest_of([*written, *((_PACKAGE / name).read_text("utf-8") for name in _FORMULAS)])


@cache
def header_text() -> str:
    """Return the text of the header that Python reads."""
    return (CORE / _HEADER).read_text(encoding="utf-8")


def core_declarations() -> str:
    """Return the declarations of core.h in the form that cffi reads."""
    return declarations(header_text())


def declarations(header: str) -> str:
    """Return the declarations of a C header for cffi, without directives except integer constants."""
    plain = _ONLY_CPP.sub("", _COMMENT.sub(" ", header))
    declared = _DIRECTIVE.sub(lambda line: line[0] if _CONSTANT.fullmatch(line[0]) else "", plain)
    return f"typedef double real;\ntypedef double ddmpc_time;\n{declared}"
