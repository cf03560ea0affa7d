"""Construction of the node's status message for /diagnostics."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from diffdrive_mpc.models.step_scalars import scalars_of, step_scalars
from diffdrive_mpc.mpc.ros.control_loop import ControlLoop, LoopState
from diffdrive_mpc.mpc.ros.conversions import time_message
from diffdrive_mpc.mpc.ros.latency import Durations
from diffdrive_mpc.mpc.ros.node_part import NodePart
from diffdrive_mpc.mpc.ros.reference_input import tracking_error
from diffdrive_mpc.mpc.ros.topic_watch import TopicWatch
from diffdrive_mpc.mpc.step_result import Mode, StepResult


def diagnostics(
    name: str,
    time: int,
    lifecycle: str,
    loop: ControlLoop | None,
    parts: Iterable[NodePart] = (),
) -> DiagnosticArray:
    """Build a message with one status, named after the node.

    Parameters
    ----------
    name
        Full name of the node without the leading slash; the namespace distinguishes robots.
    time
        Current time [ns].
    lifecycle
        Label of the lifecycle state.
    loop
        Control loop; None while the node is not active.
    parts
        Parts of the node, which add values and warnings.
    """
    status = DiagnosticStatus(name=f"{name}: control", hardware_id=name, level=DiagnosticStatus.OK, message=lifecycle)
    values = {"lifecycle": lifecycle}
    if loop is not None:
        values |= _values(loop)
        status.level = _level(loop)
        if loop.last is not None:
            stop_reason = "" if loop.stop_reason in loop.last.message else loop.stop_reason
            faults = loop.last.message, stop_reason, loop.inbox.fault, loop.warning, loop.refusal, loop.shortfall
            faults_text = "; ".join(filter(None, faults))
            state = loop.last.mode if loop.last.result is None else loop.last.result.state
            status.message = f"{state}: {faults_text}" if faults_text else state
    for part in parts:
        if loop is not None:
            values |= _watches(part.topics, loop.inbox.now)
        values |= part.diagnostics()
        fault = part.fault
        if fault and status.level == DiagnosticStatus.OK:
            status.level, status.message = DiagnosticStatus.WARN, f"{status.message}; {fault}"
    status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
    array = DiagnosticArray(status=[status])
    array.header.stamp = time_message(time)
    return array


def _level(loop: ControlLoop) -> bytes:
    if loop.state is LoopState.FAULT:
        return DiagnosticStatus.ERROR
    if loop.stop_reason:
        return DiagnosticStatus.ERROR
    tick, warning = loop.last, loop.warning or loop.refusal or loop.shortfall
    if tick is None or tick.result is None:
        return DiagnosticStatus.WARN if loop.held or warning else DiagnosticStatus.OK
    if tick.result.mode in (Mode.BRAKING, Mode.STOPPED) and loop.state is LoopState.DRIVING and not loop.held:
        return DiagnosticStatus.ERROR
    is_ok = tick.result.state in (Mode.TRACKING, Mode.FINISHED) and not tick.message and not loop.inbox.fault
    is_ok = is_ok and not warning
    return DiagnosticStatus.OK if is_ok else DiagnosticStatus.WARN


def _values(loop: ControlLoop) -> dict[str, str]:
    times, inbox = loop.times, loop.inbox
    values = {
        "state": str(loop.state),
        "held": "yes" if loop.held else "no",
        "speed limit [m/s]": "none" if loop.speed_limit is None else f"{loop.speed_limit:.3f}",
        "step time p50/p99/max [ms]": _milliseconds(times.step),
        "period jitter p50/p99/max [ms]": _milliseconds(times.jitter),
        "odometry stamp to command p50/p99/max [ms]": _milliseconds(times.latency),
        "deadline misses": str(times.misses),
        "fallbacks": str(loop.fallbacks),
    }
    values |= _watches(inbox.topics, inbox.now)
    if inbox.frames is not None:
        values["transforms"] = f"{inbox.frames.accepted} accepted, {inbox.frames.refused} refused"
        values["reference moved with its frame"] = str(loop.frame_shifts)
        if inbox.frames.last_refusal:
            values["transforms last refusal"] = inbox.frames.last_refusal
    if loop.last is not None and loop.last.result is not None:
        values |= _result(loop.last.result)
    return values


def _watches(topics: Sequence[TopicWatch], now: float) -> dict[str, str]:
    values = {}
    for watch in topics:
        values[f"{watch.name} age [s]"] = f"{watch.age(now):.3f}"
        values[f"{watch.name} delay on arrival [s]"] = f"{watch.delay:.3f}"
        values[f"{watch.name} messages"] = f"{watch.accepted} accepted, {watch.refused} refused"
        if watch.last_refusal:
            values[f"{watch.name} last refusal"] = watch.last_refusal
    return values


def _result(result: StepResult) -> dict[str, str]:
    values = {
        "mode": str(result.mode),
        "solver": f"{result.solver.status}, by {result.solver.method}, {result.solver.iterations} iterations",
        "sensors not used": ", ".join(result.unused_sensors) or "none",
    }
    scalars = step_scalars()
    values |= {scalars[name].title: f"{value:.{scalars[name].digits}f}" for name, value in scalars_of(result).items()}
    if not math.isnan(result.clearance):
        values["pressed by"] = ", ".join(result.pressed_by) or "nothing"
    error = tracking_error(result)
    if error is not None:
        values["error along, across [m], heading [rad]"] = "{:.4f}, {:.4f}, {:.4f}".format(*error)
    return values


def _milliseconds(durations: Durations) -> str:
    percentiles = durations.percentiles()
    return " / ".join(
        "-" if math.isnan(v) else f"{1e3 * v:.2f}" for v in (percentiles.p50, percentiles.p99, percentiles.max)
    )
