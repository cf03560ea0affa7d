"""Check that an exported controller fits the robot's microcontroller: `python .ci/check_export.py export.json`."""

import json
import sys
from pathlib import Path

# Half of the 20 ms at 100 MHz in packages/extras/docs/export.md, with active soft limits. QEMU counts instructions.
LIMITS = {"instructions_max": 1_000_000, "flash_bytes": 100_000, "ram_bytes": 165_000}
LARGEST_DIFFERENCE = 2e-4

report = json.loads(Path(sys.argv[1]).read_text())
(size,) = (size for size in report["sizes"] if size["target"] == "STM32F4 program")
drive = report["emulation"]
figures = {"instructions_max": drive["instructions_max"], **{name: size[name] for name in ("flash_bytes", "ram_bytes")}}
complaints = [
    f"{name}: {figures[name]:,}, below {LIMITS[name]:,} is promised" for name in LIMITS if figures[name] >= LIMITS[name]
]
if set(drive["modes"]) - {"TRACKING", "FINISHED"}:
    complaints.append(f"modes: {drive['modes']}, tracking to the end is promised")
if not drive["command_difference_max"] <= LARGEST_DIFFERENCE:
    complaints.append(
        f"commands: {drive['command_difference_max']:.1e} off Python's, at most {LARGEST_DIFFERENCE} is promised"
    )
if not 0 < drive["iterations_max"] < report["iteration_limit"]:
    complaints.append(f"iterations: at most {drive['iterations_max']}, some and less than the limit are promised")
print(", ".join(f"{name} {value:,}" for name, value in figures.items()))
if complaints:
    sys.exit("\n".join(complaints))
