"""All looks, in the order of the table."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Iterator
from dataclasses import asdict

from diffdrive_mpc.app.doctor import computer, pictures, product, real_time, ros
from diffdrive_mpc.app.doctor.machine import Machine, MachineFinding
from diffdrive_mpc.bench.machine import describe_machine, git_revision, project_version
from diffdrive_mpc.bench.table import Table

Look = Callable[[Machine], MachineFinding | Iterator[MachineFinding]]
LOOKS: dict[str, tuple[Look, ...]] = {
    "controller": (
        product.controller,
        product.core,
        product.compiler,
        product.cache_folder,
        product.dependencies,
        product.extras,
        product.blas_threads,
    ),
    "computer": (
        computer.processor,
        computer.governor,
        computer.turbo,
        computer.memory,
        computer.virtualisation,
    ),
    "time": (
        real_time.timer,
        real_time.sleep_jitter,
        real_time.kernel,
        real_time.real_time_permission,
        real_time.clock,
    ),
    "pictures": (pictures.display, pictures.off_screen, pictures.ffmpeg),
    "ROS 2": (ros.ros, ros.middleware, ros.domain, ros.multicast, ros.shared_memory),
}
"""By what they are about."""


def examine(machine: Machine | None = None) -> dict[str, list[MachineFinding]]:
    """What every look found, by what it is about. A look that fails is a finding, too."""
    where = machine or Machine()
    return {about: [one for look in looks for one in _careful(look, where)] for about, looks in LOOKS.items()}


def _careful(look: Look, machine: Machine) -> list[MachineFinding]:
    try:
        findings = look(machine)
        return [findings] if isinstance(findings, MachineFinding) else list(findings)
    except Exception as error:
        name = look.__name__.replace("_", " ")
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return [MachineFinding(name, "unknown", reason, "could not be looked at")]


def can_run(findings: dict[str, list[MachineFinding]]) -> bool:
    """Whether nothing is missing that the controller needs."""
    return not any(finding.needed and finding.status == "missing" for group in findings.values() for finding in group)


def heading() -> str:
    """Version, Python and system in one line."""
    revision = git_revision()
    name = f"diffdrive-mpc {project_version()}" + (f", revision {revision}" if revision else "")
    return f"{name}; Python {platform.python_version()}; {describe_machine()['os']}, {platform.machine()}"


def tables(findings: dict[str, list[MachineFinding]]) -> Iterator[Table]:
    """One table for each subject."""
    for about, group in findings.items():
        rows = tuple((finding.what, finding.status, finding.found, finding.means) for finding in group)
        yield Table("", (about, "", "found", "what it means"), rows, text_columns=4)


def as_json(groups: dict[str, list[MachineFinding]]) -> str:
    """The same for programs."""
    findings = {about: [asdict(finding) for finding in group] for about, group in groups.items()}
    return json.dumps({"heading": heading(), "can_run": can_run(groups), "findings": findings}, indent=2)
