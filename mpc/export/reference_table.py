"""A trajectory as a table in C, for `ddmpc_table_reference`."""

from __future__ import annotations

import re

import numpy as np

from diffdrive_mpc.models.interface import Reference


def table_text(reference: Reference, spacing: float) -> tuple[str, str]:
    """Source and header of the table of `reference`, with a row every `spacing` [s] and one at its end.

    Raises
    ------
    ValueError
        If the reference is somewhere not finite.
    """
    rows = max(2, int(np.ceil(reference.duration / spacing - 1e-9)) + 1)
    times = np.minimum(np.arange(rows) * spacing, reference.duration)
    sample = reference.sample(times)
    points_at = np.hstack([sample.pose, sample.twist])
    if not np.isfinite(points_at).all():
        worst = times[np.argmin(np.isfinite(points_at).all(axis=1))]
        raise ValueError(f"reference '{reference.name}': it is not finite at {worst:.2f} s; repair it")
    name = f"ddmpc_{_identifier(reference.name)}"
    points = ",\n".join("    {" + ", ".join(f"R({float(value)!r})" for value in row) + "}" for row in points_at)
    source = (
        '#include "trajectory.h"\n\n'
        f"static const ddmpc_point points[{rows}] = {{\n{points}\n}};\n\n"
        f"const ddmpc_table {name} = {{points, {rows}, {spacing!r}, {float(reference.duration)!r}}};\n"
    )
    header = (
        "#ifndef DDMPC_TRAJECTORY_H\n#define DDMPC_TRAJECTORY_H\n\n"
        '#include "trajectory_table.h"\n\n'
        f"/* {_comment(reference.name)} */\n"
        f"extern const ddmpc_table {name};\n#define DDMPC_TRAJECTORY {name}\n\n#endif\n"
    )
    return source, header


def _identifier(name: str) -> str:
    return re.sub(r"\W", "_", name, flags=re.ASCII).lower() or "trajectory"


def _comment(name: str) -> str:
    return name.replace("*/", "* /")
