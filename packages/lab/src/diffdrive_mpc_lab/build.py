"""Build the laboratory: one page that holds the controller as WebAssembly, its data and everything else.

Run as ``python -m diffdrive_mpc_lab.build PAGE.html``. The compiler is Zig's, from the package index (extra `lab`).
"""

from __future__ import annotations

import base64
import gzip
import importlib.util
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.core_sources import core_texts, require
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.compiled.compiler import NotCompiledError
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc_lab.formulas import generate_plant
from diffdrive_mpc_lab.numbers import generated_texts, report_fields
from diffdrive_mpc_lab.pool import page_data

require(1)

FOLDER = Path(__file__).parent
_FLAGS = (
    *("-target", "wasm32-wasi", "-mexec-model=reactor", "-std=c99", "-O3", "-msimd128", "-s"),
    # Nothing is contracted: the same bits in every browser.
    *("-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-DDDMPC_NOW=lab_now"),
)
_LONGEST = 300.0
"""How long the compiler may take [s]; its first call of a machine compiles a C library, too."""
SCRIPTS = ("engine.js", "settings.js", "view.js", "page.js")


def has_compiler() -> bool:
    """Whether Zig is installed beside this Python."""
    return importlib.util.find_spec("ziglang") is not None


def texts() -> dict[str, str]:
    """Every C file and header by name."""
    plant = generate_plant()
    written = {path.name: path.read_text(encoding="utf-8") for path in sorted(FOLDER.glob("*.[ch]"))}
    generated = {f"{plant.stem}.c": plant.source, f"{plant.stem}.h": plant.header}
    return core_texts() | generated | generated_texts() | written


def compile_module() -> bytes:
    """The WebAssembly module.

    Raises
    ------
    NotCompiledError
        If there is no compiler, or it does not take the sources.
    """
    if not has_compiler():
        raise NotCompiledError("the laboratory needs Zig's C compiler: pip install ziglang, or make lab")
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for name, text in texts().items():
            (folder / name).write_text(text, encoding="utf-8")
        sources = [str(path) for path in sorted(folder.glob("*.c"))]
        command = [sys.executable, "-m", "ziglang", "cc", *_FLAGS, f"-I{folder}", *sources, "-o", f"{folder}/lab.wasm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_LONGEST)
        if done.returncode:
            reason = next((line for line in done.stderr.splitlines() if "error" in line), "it does not say why")
            raise NotCompiledError(f"the laboratory is not compiled: {reason}")
        return (folder / "lab.wasm").read_bytes()


def page_text() -> str:
    """The page; raises NotCompiledError as `compile_module`."""
    module = compile_module()
    index, numbers = page_data()
    index["report"] = report_fields((FOLDER / "lab.h").read_text(encoding="utf-8"))
    parts = {"module": module, "numbers": numbers, "index": json.dumps(index, allow_nan=False).encode()}
    held = {name: base64.b64encode(gzip.compress(part, 9, mtime=0)).decode() for name, part in parts.items()}
    script = "\n".join((FOLDER / "page" / name).read_text(encoding="utf-8") for name in SCRIPTS)
    page = (FOLDER / "page" / "page.html").read_text(encoding="utf-8")
    style = (FOLDER / "page" / "page.css").read_text(encoding="utf-8")
    held_text = "".join(f'<script type="text/plain" id="held-{name}">{text}</script>' for name, text in held.items())
    for mark, text in (("STYLE", style), ("HELD", held_text), ("SCRIPT", script)):
        page = page.replace(f"<!--{mark}-->", text)
    return page


def main(words: Sequence[str]) -> int:
    """Write the page that `words` name, by default out/lab.html; a failure is one line on stderr, and 1."""
    try:
        page = Path(words[0] if words else "out/lab.html")
        text = page_text()
        page.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(page) as draft:
            draft.write_text(text, encoding="utf-8")
    except (NotCompiledError, ConfigError, OSError) as error:
        echo(f"error: {error}", err=True)
        return 1
    echo(f"{page}: {len(text.encode()) / 1e6:.2f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
