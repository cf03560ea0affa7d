"""How large an exported controller is, where a compiler is there to say."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from diffdrive_mpc.models.checked_yaml import ConfigError

# As in stm32f4/toolchain.cmake and stm32f4/stm32f4.ld of the exported folder.
_CORTEX_M4 = [
    *("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-ffp-contract=fast", "-fno-math-errno"),
    *("-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections", "-nostartfiles"),
    *("--specs=nano.specs", "--specs=nosys.specs"),
]
_STACK = ".stack"

TARGETS = {"STM32F4 program": "arm-none-eabi-gcc", "host example": "gcc"}
"""Programs of an exported folder, and the compiler that each needs."""


@dataclass(frozen=True)
class Size:
    """Static sizes of a linked program [bytes].

    Attributes
    ----------
    target
        What was built.
    compiler
        Name of the compiler.
    flash
        Code, constants and initial values.
    ram
        Variables, the stack that is set aside included.
    stack
        That stack; 0 where the system provides it.
    """

    target: str
    compiler: str
    flash: int
    ram: int
    stack: int

    def as_json(self) -> dict[str, object]:
        """For export.json."""
        named = asdict(self)
        return {key if isinstance(value, str) else f"{key}_bytes": value for key, value in named.items()}


def link_stm32f4(folder: Path, program: Path) -> bool:
    """Link the STM32F4 program of an exported `folder`; False if the memory does not hold it.

    Raises ConfigError if the compiler is not installed, or does not take the sources.
    """
    return _link("STM32F4 program", folder, program)


def measure_sizes(folder: Path) -> list[Size]:
    """Build the programs of an exported `folder` with each compiler that is installed, with its binutils.

    Raises ConfigError if a compiler does not take the sources.
    """
    installed = [target for target, gcc in TARGETS.items() if shutil.which(gcc) and shutil.which(_sizer(gcc))]
    sizes = [_size(target, folder) for target in installed]
    return [size for size in sizes if size is not None]


def _size(target: str, folder: Path) -> Size | None:
    compiler = TARGETS[target]
    with TemporaryDirectory() as scratch:
        program = Path(scratch) / "program"
        if not _link(target, folder, program):
            return None
        sizer = [_sizer(compiler), "-A", str(program)]
        listed = subprocess.run(sizer, capture_output=True, text=True, check=True).stdout
    lines = [words for line in listed.splitlines() if len(words := line.split()) == 3 and words[1].isdigit()]
    sections = {name: int(size) for name, size, _ in lines}
    data, zero, stack = sections.get(".data", 0), sections.get(".bss", 0), sections.get(_STACK, 0)
    constant = sum(sections.get(name, 0) for name in (".text", ".rodata", ".ARM.exidx"))
    return Size(target, compiler, constant + data, data + zero + stack, stack)


def _sizer(compiler: str) -> str:
    """The program of binutils that lists the sections of what `compiler` has linked."""
    return compiler.removesuffix("gcc") + "size"


def _link(target: str, folder: Path, program: Path) -> bool:
    """Compile and link; False if the memory of the target does not hold it."""
    compiler, place = TARGETS[target], folder / "stm32f4"
    if shutil.which(compiler) is None:
        raise ConfigError(f"{target}: {compiler} was not found; install it")
    if compiler == "gcc":
        options, main = [], [folder / "examples" / "main.c"]
    else:
        options, main = [*_CORTEX_M4, "-T", str(place / "stm32f4.ld")], sorted(place.glob("*.c"))
    sources = [*main, *sorted((folder / "ddmpc").glob("*.c"))]
    command = [
        compiler,
        "-std=c99",
        "-O3",
        *options,
        f"-I{folder / 'ddmpc'}",
        *map(str, sources),
        "-lm",
        "-o",
        str(program),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode and "overflowed" in done.stderr:
        return False
    if done.returncode:
        lines = done.stderr.splitlines()
        said = next((line for line in lines if "error: " in line), lines[-1] if lines else "it does not say why")
        raise ConfigError(f"{target}: {compiler} failed: {said.rpartition('error: ')[2]}")
    return True
