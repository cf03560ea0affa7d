"""The computer: processor, memory, what it runs in."""

from __future__ import annotations

import platform

from diffdrive_mpc.app.doctor.machine import Machine, MachineFinding, doctor_settings, in_bytes
from diffdrive_mpc.bench.runner import available_cores

_CPUS = "sys/devices/system/cpu"


def processor(machine: Machine) -> MachineFinding:
    """Model, cores, frequency."""
    values = machine.values("proc/cpuinfo")
    name = values.get("model name") or values.get("Model") or values.get("Hardware") or platform.machine()
    mhz = values.get("cpu MHz", "").partition(".")[0]
    top = machine.number(f"{_CPUS}/cpu0/cpufreq/cpuinfo_max_freq")
    speed = f", at {mhz} MHz" if mhz else ""
    speed += f" of {top // 1000}" if top else ""
    cores = available_cores()
    share = _quota(machine)
    description = f"{name}, {cores} cores{speed}"
    if share is not None and share < cores:
        return MachineFinding(
            "processor",
            "warn",
            f"{description}, of which this container may use {share:g}",
            "studies take longer; raise its limit (--cpus)",
        )
    return MachineFinding("processor", "ok", description, "studies use all cores, a controller one")


def _quota(machine: Machine) -> float | None:
    """Cores that the container's limit is worth."""
    words = (machine.text("sys/fs/cgroup/cpu.max") or "").split()
    return int(words[0]) / int(words[1]) if len(words) == 2 and all(word.isdigit() for word in words) else None


def governor(machine: Machine) -> MachineFinding:
    """Who chooses the frequency."""
    governors = sorted(set(machine.texts(f"{_CPUS}/cpu[0-9]*/cpufreq/scaling_governor")))
    if not governors:
        return MachineFinding(
            "CPU governor", "unknown", "not to be seen", "as usual in virtual machines; the host decides"
        )
    if governors == ["performance"]:
        return MachineFinding("CPU governor", "ok", "performance", "full frequency at all times")
    means = "a step may take two or three times as long after a pause: sudo cpupower frequency-set -g performance"
    return MachineFinding("CPU governor", "warn", ", ".join(governors), means)


def turbo(machine: Machine) -> MachineFinding:
    """Whether the frequency may rise for a while."""
    off = machine.number(f"{_CPUS}/intel_pstate/no_turbo")
    boost = machine.number(f"{_CPUS}/cpufreq/boost")
    if off is None and boost is None:
        return MachineFinding("turbo", "unknown", "not to be seen", "as usual in virtual machines and on ARM")
    on = off == 0 if off is not None else boost == 1
    return MachineFinding(
        "turbo", "ok", "on" if on else "off", "step times vary with heat" if on else "step times vary less"
    )


def memory(machine: Machine) -> MachineFinding:
    """Memory that is left, for this container too."""
    values = machine.values("proc/meminfo")
    available = _kilobytes(values.get("MemAvailable")) or _kilobytes(values.get("MemFree"))
    total = _kilobytes(values.get("MemTotal"))
    limit = machine.number("sys/fs/cgroup/memory.max")
    if available is None or total is None:
        return MachineFinding(
            "memory", "unknown", "not to be seen", "a controller needs 0.2 GB, a study 0.3 GB a process"
        )
    left = min(available, limit) if limit is not None else available
    description = f"{in_bytes(left)} of {in_bytes(total)} free" + (
        f", limit {in_bytes(limit)}" if limit is not None else ""
    )
    if left < doctor_settings().least_memory:
        return MachineFinding("memory", "warn", description, "studies may be ended by the system: fewer --jobs")
    return MachineFinding("memory", "ok", description, "a controller needs 0.2 GB, a study 0.3 GB a process")


def _kilobytes(text: str | None) -> int | None:
    number = (text or "").removesuffix("kB").strip()
    return int(number) * 1024 if number.isdigit() else None


def virtualisation(machine: Machine) -> MachineFinding:
    """What all this runs in."""
    inside = []
    if machine.there(".dockerenv") or machine.there("run/.containerenv") or machine.variable("container"):
        inside.append("a container")
    if "microsoft" in (machine.text("proc/sys/kernel/osrelease") or "").lower():
        inside.append("WSL")
    elif "hypervisor" in machine.values("proc/cpuinfo").get("flags", "").split():
        inside.append("a virtual machine")
    if not inside:
        return MachineFinding("virtualisation", "ok", "none to be seen", "times are the machine's own")
    means = "ok to simulate; the host takes the processor away at times: do not judge step times here"
    virtual = inside != ["a container"]
    return MachineFinding(
        "virtualisation", "warn" if virtual else "ok", " in ".join(inside), means if virtual else "its limits count"
    )
