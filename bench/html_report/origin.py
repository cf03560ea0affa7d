"""How a run can be repeated: the command, and what it was carried out with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from diffdrive_mpc.bench.command_line.words import command_line
from diffdrive_mpc.bench.html_report.page import Origin


def origin(run: Mapping[str, Any], more: Sequence[tuple[str, str]] = ()) -> Origin:
    """The origin of a report.

    Parameters
    ----------
    run
        As `bench.machine.describe_run` gives it.
    more
        Other facts as name and value, such as seeds.
    """
    machine = run["machine"]
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    revision = [("revision", run["revision"])] if run["revision"] else []
    facts = [
        ("version", f"diffdrive-mpc {run['version']}"),
        *revision,
        *more,
        ("date", run["date"]),
        ("duration", f"{run['wall_time_s']:g} s"),
        ("machine", f"{machine['cpu']}, {machine['cores']} cores, {machine['os']}"),
        ("software", f"Python {machine['python']}, {packages}"),
    ]
    return Origin(command_line(), facts)
