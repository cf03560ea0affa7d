"""How large an exported controller is, where a compiler is there to say."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from models.checked_yaml import ConfigError

# As in stm32f4/toolchain.cmake and stm32f4/stm32f4.ld of the exported folder.
_CORTEX_M4 = (
    "-mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16 -ffp-contract=fast -ffunction-sections "
    "-fdata-sections -fno-math-errno -nostartfiles --specs=nano.specs --specs=nosys.specs -Wl,--gc-sections"
).split()
_STM32F4 = ("main.c", "frames.c", "startup.c")
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


def measure_sizes(folder: Path) -> list[Size]:
    """Build the programs of an exported `folder` with each compiler that is installed.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a compiler does not take the sources.
    """
    place = folder / "stm32f4"
    programs = {
        "STM32F4 program": ([*_CORTEX_M4, "-T", str(place / "stm32f4.ld")], [place / name for name in _STM32F4]),
        "host example": ([], [folder / "examples" / "main.c"]),
    }
    sizes = [
        _size(target, folder, compiler, *programs[target])
        for target, compiler in TARGETS.items()
        if shutil.which(compiler) and shutil.which(_sizer(compiler))
    ]
    return [size for size in sizes if size is not None]


def _sizer(compiler: str) -> str:
    return compiler.removesuffix("gcc") + "size"


def _size(target: str, folder: Path, compiler: str, options: list[str], main: list[Path]) -> Size | None:
    """Sizes of the linked program; None if the memory of the target does not hold it."""
    sources = [*main, *(folder / "ddmpc").glob("*.c"), *(folder / "osqp").glob("**/*.c")]
    includes = [f"-I{folder / name}" for name in ("ddmpc", "osqp", "osqp/inc/public", "osqp/inc/private")]
    with TemporaryDirectory() as scratch:
        program = Path(scratch) / "program"
        command = [compiler, "-std=c99", "-O2", *options, *includes, *map(str, sources), "-lm", "-o", str(program)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode and "overflowed" in done.stderr:
            return None
        if done.returncode:
            raise ConfigError(f"{target}: {compiler} failed: {_first_fault(done.stderr)}")
        listed = subprocess.run([_sizer(compiler), "-A", str(program)], capture_output=True, text=True, check=True).stdout
    sections = {words[0]: int(words[1]) for line in listed.splitlines() if len(words := line.split()) == 3 and words[1].isdigit()}
    data, zero, stack = sections.get(".data", 0), sections.get(".bss", 0), sections.get(_STACK, 0)
    constant = sum(sections.get(name, 0) for name in (".text", ".rodata", ".ARM.exidx"))
    return Size(target, compiler, constant + data, data + zero + stack, stack)


def _first_fault(stderr: str) -> str:
    lines = stderr.splitlines()
    said = next((line for line in lines if "error: " in line), lines[-1] if lines else "it does not say why")
    return said.rpartition("error: ")[2]
