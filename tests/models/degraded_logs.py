"""Logs made worse on purpose, each with a known cause: what must be said about them, and whether they may give a model.

Bases are simulated robots and slices of the logs of a Husky and two Warthogs. `FIRST_TEN` and
`CAUSES` were written before any of their results had been looked at.
"""

import numpy as np
from degraded_bases import BASES, SIDES_ONLY, robot
from degraded_causes import CAUSES
from degraded_changes import (
    SHIFT,
    UNIT,
    Case,
    four_wheels,
    one_wheel,
    put,
    replaced,
    rounded,
    rows,
    scaled,
    shifted,
    shuffled_rows,
    simulated,
    swapped,
    twist_columns,
)
from degraded_readings import READINGS
from degraded_scales import SCALES
from degraded_times import TIMES

FIRST_TEN = (
    Case("husky", "gyro 0.3 s late", shifted("gyro", 0.3), SHIFT, ("gyro", "delay"), None),
    Case("husky", "commands 0.3 s late", shifted("command", 0.3), SHIFT, ("command", "delay"), True),
    Case("husky", "encoders in rpm", scaled(encoders=60 / (2 * np.pi)), UNIT, ("encoders", "unit: rpm"), True),
    Case("husky", "yaw in degrees", scaled(yaw=180 / np.pi), UNIT, ("pose", "unit: deg"), True),
    Case("simulated", "milliseconds", scaled(t=1000.0), UNIT, ("time", "unit: ms"), True),
    Case("simulated", "right wheel dead", one_wheel(1, 0.0), ("dead wheel",), ("right",), True),
    Case("husky", "sides swapped", swapped("left", "right"), ("swapped sides",), ("encoders",), True),
    Case("simulated", "y mirrored", scaled(y=-1.0), ("mirrored pose",), ("y", "sign: -1"), True),
    Case("simulated", "rows shuffled", rows(shuffled_rows), ("shuffled stamps",), ("sort",), True),
    Case("simulated", "quantised encoders", replaced(left=rounded("left", 0.8), right=rounded("right", 0.8)), ()),
)

SOUND = (
    *(Case(base, "as it is", lambda columns, base: columns) for base in ("simulated", "husky", "asphalt", "gravel")),
    Case("simulated", "slow", simulated(lag=0.5, seed=11)),
    Case("simulated", "much skid", simulated(skid=0.35, seed=12)),
    Case("simulated", "gain 0.8", simulated(gain=(0.8, 1.2), seed=13)),
    Case("simulated", "v and omega of the encoders", twist_columns, mapping=lambda _: SIDES_ONLY),
    Case(
        "simulated",
        "four sound wheels",
        four_wheels(),
        mapping=put("{left: left, right: right}", "{front_left: fl, front_right: fr, rear_left: rl, rear_right: rr}"),
    ),
    Case("simulated", "two drives of one robot", lambda columns, base: [columns, robot(seed=22)]),
)

CASES = (*FIRST_TEN, *SOUND, *SCALES, *TIMES, *READINGS, *CAUSES)


def write_columns(path, columns):
    """A CSV file; a column of NaN alone becomes one of empty cells."""
    table = np.column_stack(list(columns.values()))
    empty = np.isnan(table).all(axis=0)
    lines = [
        ",".join("" if e else f"{cell:.12g}" for e, cell in zip(empty, row, strict=True)) for row in table.tolist()
    ]
    path.write_text("\n".join([",".join(columns), *lines]) + "\n")
    return path


def logs_of(case, folder):
    """Files of the degraded log or logs, and the mapping."""
    base = BASES[case.base]
    changed = case.change(base.columns(), base)
    together = changed if isinstance(changed, list) else [changed]
    paths = [write_columns(folder / f"log{i}.csv", columns) for i, columns in enumerate(together)]
    mapping = folder / "map.yaml"
    mapping.write_text(case.mapping(base.mapping))
    return paths, mapping


def verdict(case, findings, raised=None):
    """ "right", "half", "wrong" or "missed": whether the findings name the cause of the case, and no other.

    Notes name no cause, unless a note is what is asked for.
    """
    named = [finding for finding in findings if finding.kind in case.kind]
    others = [
        finding for finding in findings if finding.severity != "note" and finding.kind not in (*case.kind, *case.also)
    ]
    if raised is not None:
        others = []  # a file that cannot be read says its cause in one line
    if not case.kind:
        return "wrong" if others or raised else "right"
    whole = any(all(word in str(finding) for word in case.says) for finding in named)
    whole |= raised is not None and all(word in raised for word in case.says)
    if whole and not others:
        return "right"
    if named or whole:
        return "half"
    return "wrong" if others or raised else "missed"
