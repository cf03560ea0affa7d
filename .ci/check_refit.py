"""Compare refitted parameter files with the shipped ones: `python .ci/check_refit.py NEW SHIPPED [NEW SHIPPED ...]`.

Numbers, also in texts, may differ by a small tolerance, because results depend on the machine. The date is ignored.
"""

import math
import re
import sys
from pathlib import Path

import yaml

RELATIVE, ABSOLUTE = 0.02, 1e-4
NUMBER = r"\d[\d.e+-]*"


def differences(new: object, shipped: object, place: str = "") -> list[str]:
    """List the places at which two parameter files disagree."""
    if isinstance(new, dict) and isinstance(shipped, dict):
        if new.keys() != shipped.keys():
            return [f"{place}: keys differ"]
        return [line for key in new if key != "date" for line in differences(new[key], shipped[key], f"{place}.{key}")]
    if isinstance(new, list) and isinstance(shipped, list) and len(new) == len(shipped):
        pairs = enumerate(zip(new, shipped, strict=True))
        return [line for k, (a, b) in pairs for line in differences(a, b, f"{place}[{k}]")]
    if isinstance(new, float) and isinstance(shipped, float):
        close = math.isclose(new, shipped, rel_tol=RELATIVE, abs_tol=ABSOLUTE)
        return [] if close else [f"{place}: {new} against {shipped}"]
    same = re.sub(NUMBER, "#", str(new)) == re.sub(NUMBER, "#", str(shipped))
    return [] if same else [f"{place}: {new!r} against {shipped!r}"]


complaints = []
for new, shipped in zip(sys.argv[1::2], sys.argv[2::2], strict=True):
    mismatches = differences(
        *(yaml.safe_load(Path(name).read_text()) for name in (new, shipped)), place=Path(shipped).name
    )
    print(f"{shipped}: {'as shipped' if not mismatches else 'differs'}")
    complaints += mismatches
if complaints:
    sys.exit("\n".join(complaints))
