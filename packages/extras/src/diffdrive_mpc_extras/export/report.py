"""Export of a controller with README, static sizes and report, for the command line."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from diffdrive_mpc.bench.case import label
from diffdrive_mpc.bench.controllers import controller_config, select_model
from diffdrive_mpc.bench.machine import describe_run
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.report_folder import staged
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import Reference
from diffdrive_mpc.mpc import ControllerConfig, load_trajectory
from diffdrive_mpc.mpc.config.typed_settings import parse_single_settings
from diffdrive_mpc_extras.export.emulation import emulate
from diffdrive_mpc_extras.export.library import FILES, FOLDERS, Precision, export_controller


def readme(facts: Mapping[str, object], tables: Sequence[Table]) -> str:
    """Return the README of an export from its `facts` and the tables of the measurements."""
    text = Path(__file__).with_name("sources").joinpath("readme.md").read_text(encoding="utf-8")
    return text.format(**facts) + "\n".join(table.markdown() for table in tables)


# Options of stm32f4/toolchain.cmake and stm32f4/stm32f4.ld in the exported folder.
_CORTEX_M4 = [
    *("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-ffp-contract=fast", "-fno-math-errno"),
    *("-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections", "-nostartfiles"),
    *("--specs=nano.specs", "--specs=nosys.specs"),
]
_STACK = ".stack"

TARGETS = {"STM32F4 program": "arm-none-eabi-gcc", "host example": "gcc"}
"""Programs of an exported folder, with their compilers."""


@dataclass(frozen=True)
class Size:
    """Static sizes of a linked program [bytes].

    Attributes
    ----------
    target
        Target of the build.
    compiler
        Name of the compiler.
    flash
        Size of code, constants and initial values.
    ram
        Size of the variables, including the reserved stack.
    stack
        Size of the reserved stack; 0 if the operating system provides the stack.
    """

    target: str
    compiler: str
    flash: int
    ram: int
    stack: int

    def as_json(self) -> dict[str, object]:
        """Convert to JSON values for export.json."""
        fields = asdict(self)
        return {key if isinstance(value, str) else f"{key}_bytes": value for key, value in fields.items()}


def link_stm32f4(folder: Path, program: Path) -> bool:
    """Link the STM32F4 program of an exported `folder`; return False if it exceeds the memory.

    Raises ConfigError if the compiler is not installed or rejects the sources.
    """
    return _link("STM32F4 program", folder, program)


def measure_sizes(folder: Path) -> list[Size]:
    """Build each program of an exported `folder` whose compiler and binutils are installed; return the sizes.

    Raises ConfigError if a compiler rejects the sources.
    """
    installed = [target for target, gcc in TARGETS.items() if shutil.which(gcc) and shutil.which(_size_command(gcc))]
    sizes = [_size(target, folder) for target in installed]
    return [size for size in sizes if size is not None]


def _size(target: str, folder: Path) -> Size | None:
    compiler = TARGETS[target]
    with TemporaryDirectory() as scratch:
        program = Path(scratch) / "program"
        if not _link(target, folder, program):
            return None
        command = [_size_command(compiler), "-A", str(program)]
        listing = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    rows = [cells for line in listing.splitlines() if len(cells := line.split()) == 3 and cells[1].isdigit()]
    sections = {name: int(size) for name, size, _ in rows}
    data, bss, stack = sections.get(".data", 0), sections.get(".bss", 0), sections.get(_STACK, 0)
    constants = sum(sections.get(name, 0) for name in (".text", ".rodata", ".ARM.exidx"))
    return Size(target, compiler, constants + data, data + bss + stack, stack)


def _size_command(compiler: str) -> str:
    """Return the binutils program `size` that belongs to `compiler`."""
    return compiler.removesuffix("gcc") + "size"


def _link(target: str, folder: Path, program: Path) -> bool:
    """Compile and link `program`; return False if it exceeds the memory of the target."""
    compiler, target_folder = TARGETS[target], folder / "stm32f4"
    if shutil.which(compiler) is None:
        raise ConfigError(f"{target}: {compiler} was not found; install it")
    if compiler == "gcc":
        options, main = [], [folder / "examples" / "main.c"]
    else:
        options, main = [*_CORTEX_M4, "-T", str(target_folder / "stm32f4.ld")], sorted(target_folder.glob("*.c"))
    sources = [*main, *sorted((folder / "ddmpc").glob("*.c"))]
    flags = ["-std=c99", "-O2", *options, f"-I{folder / 'ddmpc'}"]
    command = [compiler, *flags, *map(str, sources), "-lm", "-o", str(program)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode and "overflowed" in result.stderr:
        return False
    if result.returncode:
        lines = result.stderr.splitlines()
        reason = next((line for line in lines if "error: " in line), lines[-1] if lines else "no error message")
        raise ConfigError(f"{target}: {compiler} failed: {reason.rpartition('error: ')[2]}")
    return True


README, REPORT = "README.md", "export.json"


def export_library(
    out: Path,
    *,
    model: str | None,
    config: Path | None,
    settings: Sequence[str],
    trajectory: str,
    precision: str,
    run_emulation: bool,
) -> None:
    """Export a controller into the folder `out` and print its sizes; the parameters are the options of the command.

    Raises ConfigError, ValueError or OSError if a name, a value or `out` is invalid; `out` is unchanged then.
    """
    start = time.perf_counter()
    if precision not in list(Precision):
        raise ConfigError(f"--precision '{precision}': give double or float")
    name = select_model(model, config)
    values = controller_config(name, None if config is None else str(config), parse_single_settings(settings))
    reference = load_trajectory(trajectory, values)
    with (
        staged(out, files=(*FILES, README, REPORT), folders=FOLDERS, owner="export") as folder,
        ProgressBar("exporting") as bar,
    ):
        exported = export_controller(values, reference, folder, Precision(precision))
        sizes = measure_sizes(folder)
        facts: dict[str, Any] = {
            "model": label(name),
            "states": exported.states,
            "horizon": values.horizon,
            "sample_time_s": values.sample_time,
            "precision": precision,
            "trajectory": label(trajectory),
            "terms": list(exported.terms),
            "iteration_limit": values.solver.active_set_iterations,
            "operations_bound": exported.operations_bound,
            "sizes": [size.as_json() for size in sizes],
        }
        if run_emulation:
            facts["emulation"] = _emulate(folder, values, reference, bar)
        tables = [size_table(sizes), *([emulation_table(facts["emulation"])] if run_emulation else [])]
        (folder / README).write_text(readme(facts, tables), encoding="utf-8")
        report = {
            "meta": describe_run(time.perf_counter() - start),
            **facts,
            "config": {**values.model_dump(mode="json"), "model": label(name)},
        }
        (folder / REPORT).write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    console = output_console()
    for table in tables:
        console.print(table.rich())
    console.print(f"controller in {out}: {name}, {values.horizon} steps, {precision} precision", highlight=False)


def _emulate(folder: Path, config: ControllerConfig, reference: Reference, bar: ProgressBar) -> dict[str, object]:
    with TemporaryDirectory() as scratch:
        image = Path(scratch) / "program.elf"
        if not link_stm32f4(folder, image):
            raise ConfigError("--emulate: too large for an STM32F4; use --precision float or a shorter horizon")
        bar.start_stage("emulating", 1)
        return emulate(image, config, reference, bar.show).as_json()


def emulation_table(facts: Mapping[str, Any]) -> Table:
    """Return a table of the instructions per step on the emulated microcontroller."""
    counts = {name: f"{facts[f'instructions_{name}']:,}" for name in ("p50", "p95", "p99", "max")}
    cells = {"machine": str(facts["machine"]), "steps": str(facts["steps"]), **counts}
    cells["iterations"] = str(facts["iterations_max"])
    cells["position RMSE [m]"] = number(facts["position_rmse_m"])
    cells["command difference"] = f"{facts['command_difference_max']:.1e}"
    note = (
        "One drive of the MuJoCo robot. `iterations`: maximum per step; `command difference`: maximum difference from "
        "the Python controller [m/s, rad/s]."
    )
    return Table("Instructions per step", tuple(cells), (tuple(cells.values()),), note=note)


def size_table(sizes: Sequence[Size]) -> Table:
    """Return a table of the static sizes; the program allocates no further memory."""
    rows = [(size.target, size.compiler, f"{size.flash:,}", f"{size.ram:,}", f"{size.stack:,}") for size in sizes]
    missing = {name: gcc for name, gcc in TARGETS.items() if name not in [size.target for size in sizes]}
    notes = [f"{name}: {'exceeds memory' if shutil.which(gcc) else f'install {gcc}'}" for name, gcc in missing.items()]
    return Table(
        "Static sizes",
        ("program", "compiler", "flash [bytes]", "RAM with stack [bytes]", "stack [bytes]"),
        tuple(rows),
        text_columns=2,
        note="; ".join(notes),
    )
