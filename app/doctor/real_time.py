"""Time: how exactly this computer wakes a control loop, and what may be done about it."""

from __future__ import annotations

import platform
import time

import numpy as np

from diffdrive_mpc.app.doctor.machine import Machine, MachineFinding, doctor_settings

_GOOD_CLOCKS = ("tsc", "kvm-clock", "arch_sys_counter", "hyperv_clocksource_tsc_page")
_CLOCK_SOURCE = "sys/devices/system/clocksource/clocksource0/current_clocksource"
_LIMITS_FILE = "/etc/security/limits.d/robot.conf"


def timer(machine: Machine) -> MachineFinding:
    """Resolution of the clock, and where it comes from."""
    resolution = time.get_clock_info("perf_counter").resolution
    source = machine.text(_CLOCK_SOURCE)
    description = f"{resolution * 1e9:.0f} ns" + (f", {source}" if source else "")
    if resolution > 1e-5:
        return MachineFinding("timer", "warn", description, "step times are told in steps of this size")
    if source and source not in _GOOD_CLOCKS:
        return MachineFinding("timer", "warn", description, "a slow clock: each look at it costs about a microsecond")
    return MachineFinding("timer", "ok", description, "fine enough for step times")


def sleep_jitter(machine: Machine) -> MachineFinding:
    """How late a loop that sleeps is woken."""
    settings = doctor_settings()
    late = np.array(machine.lateness(settings.jitter_period, settings.jitter_time)) * 1e3
    middle, high = np.percentile(late, [50, 99])
    description = (
        f"{middle:.2f} ms late in the middle, {high:.2f} ms at the 99th percentile, {late.max():.2f} ms at most"
    )
    if high > settings.most_lateness * 1e3:
        means = "a loop on this computer is late: other programs, power saving or the host; see governor and kernel"
        return MachineFinding("sleep jitter", "warn", description, means)
    return MachineFinding("sleep jitter", "ok", description, "small beside a sample time of 20 ms")


def kernel(machine: Machine) -> MachineFinding:
    """Whether the kernel lets a waiting thread go first."""
    version = machine.text("proc/version") or platform.version()
    if machine.text("sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        return MachineFinding("kernel", "ok", "PREEMPT_RT", "made for control loops")
    for kind in ("PREEMPT_DYNAMIC", "PREEMPT"):
        if kind in version:
            return MachineFinding("kernel", "ok", kind, "enough for 50 Hz; PREEMPT_RT is steadier on a robot")
    if platform.system() != "Linux":
        return MachineFinding(
            "kernel", "unknown", platform.system(), "robots run Linux; to simulate any system will do"
        )
    return MachineFinding(
        "kernel", "ok", "without PREEMPT", "enough to simulate; on a robot take PREEMPT_DYNAMIC or PREEMPT_RT"
    )


def real_time_permission(machine: Machine) -> MachineFinding:
    """Whether this user may ask for real-time priority and memory that stays."""
    priority, locked = machine.limit("RLIMIT_RTPRIO"), machine.limit("RLIMIT_MEMLOCK")
    if priority is None:
        return MachineFinding("real-time permission", "unknown", "not to be seen", "only a robot needs it")
    locked_said = "unlimited" if locked == -1 else f"{(locked or 0) // 1024} kB"
    if machine.user_id() == 0:
        return MachineFinding(
            "real-time permission",
            "ok",
            f"this is root; memlock {locked_said}",
            "`chrt -f 80` works; better a user with limits",
        )
    description = f"rtprio {'unlimited' if priority == -1 else priority}, memlock {locked_said}"
    if priority == -1 or priority >= doctor_settings().least_rtprio:
        return MachineFinding(
            "real-time permission", "ok", description, "start the node with `chrt -f 80` on a busy robot"
        )
    means = f"`chrt -f 80` is refused; on a robot: 'USER - rtprio 98', 'USER - memlock unlimited' in {_LIMITS_FILE}"
    return MachineFinding("real-time permission", "warn", description, means)


def clock(machine: Machine) -> MachineFinding:
    """Whether the system's clock is kept right."""
    synchronised = machine.clock_synchronised()
    daemons = [name for name in ("chronyd", "ntpd", "systemd-timesyncd") if machine.program(name)]
    who = f" ({', '.join(daemons)})" if daemons else ""
    if synchronised is None:
        return MachineFinding(
            "clock", "unknown", f"not to be seen{who}", "stamps of other computers must be in step: chrony"
        )
    if synchronised:
        return MachineFinding("clock", "ok", f"synchronised{who}", "stamps of other computers can be compared")
    means = "late or future stamps of other computers are refused: apt install chrony; alone it does not matter"
    return MachineFinding("clock", "warn", f"not synchronised{who}", means)
