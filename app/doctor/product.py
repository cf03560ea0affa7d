"""The product itself: does the controller run, with what, and what else is installed."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from packaging.requirements import Requirement
from packaging.version import Version

from diffdrive_mpc.app.doctor.machine import Machine, MachineFinding, doctor_settings, in_bytes
from diffdrive_mpc.models.compiled.cache import CACHE_VARIABLE, user_folder
from diffdrive_mpc.models.compiled.compiler import NotCompiledError, find_compiler

_PURPOSE = {
    "learn": "no networks are trained (driving with one needs nothing)",
    "campaign": "no campaigns and proofs",
    "tune": "no tuning",
    "rerun": "no live view",
}
"""Extras of which is said what is missing without them."""


def controller(machine: Machine) -> MachineFinding:  # noqa: ARG001 - every look takes the machine
    """Build the shipped controller and do one step."""
    try:
        from diffdrive_mpc.models.interface import Measurement, Stamped  # noqa: PLC0415 - what is broken is to be said
        from diffdrive_mpc.mpc import Controller, load_config, load_trajectory  # noqa: PLC0415

        controller = Controller(load_config("ssm"))
        controller.start(load_trajectory("circle"), 0.0)
        at_rest = Measurement(pose=Stamped((0.0, 0.0, 0.0), 0.0), yaw_rate=Stamped(0.0, 0.0))
        controller.step(0.0, at_rest)
        step = controller.step(controller.config.sample_time, Measurement())
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        return MachineFinding("controller", "missing", f"does not run: {reason}", "see the rows below", needed=True)
    return MachineFinding(
        "controller",
        "ok",
        f"{step.mode}, a step in {step.step_time * 1e3:.2f} ms",
        f"it runs, with its compiled core; at most {controller.operations_bound:,} operations a tick",
    )


def core(machine: Machine) -> MachineFinding:  # noqa: ARG001
    """Which compiled core is loaded."""
    from diffdrive_mpc.mpc.core.packaged import packaged_libraries  # noqa: PLC0415 - needs CasADi

    library = next(packaged_libraries(), None)
    if library is None:
        return MachineFinding(
            "core", "ok", f"compiled here for {platform.machine()}", "as quick as this processor allows"
        )
    level = library.stem.partition("-")[2]
    best = platform.machine() != "x86_64" or level == "x86-64-v4"
    means = (
        "from the wheel"
        if best
        else "from the wheel; compiled for this processor, as from a clone, it is a little quicker"
    )
    return MachineFinding("core", "ok", f"{level} of the wheel, on {platform.machine()}", means)


def compiler(machine: Machine) -> MachineFinding:  # noqa: ARG001
    """The C compiler."""
    try:
        path, version = find_compiler()
    except NotCompiledError:
        means = "functions of yours (costs, limits, models) cannot be compiled: apt install gcc; a wheel does the rest"
        return MachineFinding("C compiler", "missing", "none", means)
    return MachineFinding(
        "C compiler", "ok", f"{Path(path).name}: {version.splitlines()[0]}", "your own functions can be compiled"
    )


def cache_folder(machine: Machine) -> MachineFinding:
    """Where compiled libraries are kept."""
    try:
        folder = user_folder()
    except RuntimeError as error:
        return MachineFinding(
            "cache folder", "warn", str(error), f"all is compiled at each start: set {CACHE_VARIABLE}"
        )
    shown = str(folder)
    with suppress(RuntimeError):
        shown = shown.replace(str(Path.home()), "~", 1)
    there = next((place for place in (folder, *folder.parents) if place.exists()), folder)
    if not _writable(there):
        return MachineFinding(
            "cache folder", "warn", f"{shown}: not writable", f"all is compiled at each start: set {CACHE_VARIABLE}"
        )
    free = machine.free(str(there))
    if free is not None and free < doctor_settings().least_disk:
        return MachineFinding("cache folder", "warn", f"{shown}: {in_bytes(free)} free", "make room")
    return MachineFinding(
        "cache folder", "ok", f"{shown}: {in_bytes(free or 0)} free", "compiled libraries are kept there"
    )


def _writable(folder: Path) -> bool:
    return os.access(folder, os.W_OK)


def dependencies(machine: Machine) -> MachineFinding:
    """Versions of what the controller needs, against their ranges."""
    wanted = [Requirement(text) for text in machine.requirements()]
    core_ones = [
        requirement for requirement in wanted if requirement.marker is None or "extra" not in str(requirement.marker)
    ]
    if not core_ones:
        return MachineFinding("dependencies", "unknown", "this is no installed package", "pip install it, or make test")
    faults = list(_faults(core_ones, machine))
    if faults:
        return MachineFinding("dependencies", "warn", "; ".join(faults), "pip install --upgrade diffdrive-mpc")
    shown = ("numpy", "scipy", "casadi", "osqp", "daqp")
    versions = ", ".join(f"{name} {machine.installed(name)}" for name in shown)
    return MachineFinding("dependencies", "ok", versions, f"all {len(core_ones)} are there, in their ranges")


def _faults(wanted: list[Requirement], machine: Machine) -> Iterator[str]:
    for requirement in wanted:
        there = machine.installed(requirement.name)
        if there is None:
            yield f"{requirement.name} is not installed"
        elif not requirement.specifier.contains(Version(there), prereleases=True):
            yield f"{requirement.name} {there} is not {requirement.specifier}"


def extras(machine: Machine) -> Iterator[MachineFinding]:
    """What optional packages are there."""
    wanted = [Requirement(text) for text in machine.requirements()]
    for extra, purpose in _PURPOSE.items():
        own = [
            requirement
            for requirement in wanted
            if requirement.marker and re.search(rf'extra == "{extra}"', str(requirement.marker))
        ]
        own = [requirement for requirement in own if requirement.name != "diffdrive-mpc"]
        faults = list(_faults(own, machine))
        if not own:
            continue
        if faults:
            means = f"{purpose}: pip install 'diffdrive-mpc[{extra}]'"
            yield MachineFinding(f"extra {extra}", "missing", "; ".join(faults), means)
        else:
            yield MachineFinding(
                f"extra {extra}",
                "ok",
                ", ".join(f"{requirement.name} {machine.installed(requirement.name)}" for requirement in own),
                "",
            )


def blas_threads(machine: Machine) -> MachineFinding:
    """Threads of NumPy's linear algebra."""
    settings = [f"{name}={machine.variable(name)}" for name in _THREADS if machine.variable(name)]
    is_single = any(machine.variable(name) == "1" for name in _THREADS)
    if is_single:
        return MachineFinding("BLAS threads", "ok", ", ".join(settings), "one thread: matrices are small")
    means = "the controller's core uses none; studies limit them: export OMP_NUM_THREADS=1 for your own scripts"
    return MachineFinding("BLAS threads", "ok", ", ".join(settings) or "not limited", means)


_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
