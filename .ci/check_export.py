"""Check that an exported controller fits the robot's microcontroller: `python .ci/check_export.py export.json`."""

import json
import sys
from pathlib import Path

# Instructions in half a sample of 20 ms at 100 MHz, with active soft limits; see packages/extras/docs/export.md.
LIMITS = {"instructions_max": 1_000_000, "flash_bytes": 100_000, "ram_bytes": 165_000}
LARGEST_DIFFERENCE = 2e-4

report = json.loads(Path(sys.argv[1]).read_text())
(size,) = (size for size in report["sizes"] if size["target"] == "STM32F4 program")
drive = report["emulation"]
figures = {"instructions_max": drive["instructions_max"], **{name: size[name] for name in ("flash_bytes", "ram_bytes")}}
violations = [
    f"{name}: {figures[name]:,}, must be below {LIMITS[name]:,}" for name in LIMITS if figures[name] >= LIMITS[name]
]
if set(drive["modes"]) - {"TRACKING", "FINISHED"}:
    violations.append(f"modes: {drive['modes']}, only TRACKING and FINISHED are permitted")
if not drive["command_difference_max"] <= LARGEST_DIFFERENCE:
    violations.append(
        f"commands: difference from Python {drive['command_difference_max']:.1e}, must be at most {LARGEST_DIFFERENCE}"
    )
if not 0 < drive["iterations_max"] < report["iteration_limit"]:
    violations.append(f"iterations: maximum {drive['iterations_max']}, must be positive and below the limit")
print(", ".join(f"{name} {value:,}" for name, value in figures.items()))
if violations:
    sys.exit("\n".join(violations))
