"""Recording of the active node's inputs, results and messages in an MCAP file in the format of `simulate --log`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import wraps
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.serialization import serialize_message
from std_msgs.msg import String

from diffdrive_mpc.models.load import is_shipped, model_path
from diffdrive_mpc.models.logs.drive_log.recorder import DriveRecorder, Metadata
from diffdrive_mpc.models.logs.drive_log.tick import Cell, step_cells
from diffdrive_mpc.models.logs.drive_log.topics import DIAGNOSTICS, DRIVE, TICK, path_times
from diffdrive_mpc.models.logs.tick_record import DriveRecord, TickRecord
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc.mpc.ros.control_loop import Drive, LoopTick
from diffdrive_mpc.mpc.ros.inbox import Inbox
from diffdrive_mpc.mpc.ros.node_part import NodePart, NodeTools
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from diffdrive_mpc.mpc.solver.report import SolverStatus
from diffdrive_mpc.mpc.trajectories.native import table_of

# Time limit for opening the file before the first tick and for closing it after the last tick [s].
_TIMEOUT = 5.0
Method = Callable[..., None]
# Longer lines are omitted, since they exceed the message size of the writing process and would end the recording.
_MAX_LINE_LENGTH = 100_000
_REFERENCE = ("reference_x_m", "reference_y_m", "reference_theta_rad")


def _end_recording_on_error(method: Method) -> Method:
    """Wrap `method` so that an exception ends the recording instead of the node."""

    @wraps(method)
    def run(self: ActivationRecording, *arguments: Any) -> None:  # noqa: ANN401 - arguments of the method
        try:
            method(self, *arguments)
        except Exception as error:
            self.abandon(f"{type(error).__name__}: {error}")

    return run


class ActivationRecording:
    """Recording of an activation; a failure is logged once and does not affect the node.

    Parameters
    ----------
    settings, config
        Settings of the node and configuration of its controller.
    frame
        Control frame.
    logger
        Logger of the node.
    """

    def __init__(self, settings: NodeSettings, config: ControllerConfig, frame: str, logger: Any) -> None:  # noqa: ANN401
        path = Path(settings.record_folder).expanduser() / f"{datetime.now(UTC):%Y-%m-%dT%H-%M-%SZ}.mcap"
        self._logger, self._has_warned = logger, False
        self._period = round(1e9 * config.sample_time)
        self._recorder = DriveRecorder(
            path,
            _metadata(settings, config),
            timeout=_TIMEOUT,
            frame=frame,
            pose_topic=settings.poses_from != "odometry",
        )
        if not self._recorder.fault:
            logger.info(f"recording to {self._recorder.path}")
        self._warn()

    @property
    def incomplete(self) -> bool:
        """True if rows are missing in the file."""
        return bool(self._recorder.fault or self._recorder.lost)

    @property
    def status(self) -> str:
        """State of the recording: path and lost messages, or the fault that ended it."""
        recorder = self._recorder
        lost = f", {recorder.lost} messages lost: the disk is too slow" if recorder.lost else ""
        return f"ended: {recorder.fault}" if recorder.fault else f"{recorder.path}{lost}"

    @_end_recording_on_error
    def reference(self, drive: Drive, time: int) -> None:
        """Record the path of a drive that starts at `time` [ns]."""
        times = path_times(drive.reference.duration)
        stamps = (time + np.round(times * 1e9).astype(np.int64)).tolist()
        self._recorder.send("reference", time, stamps, drive.reference.sample(times).pose)

    @_end_recording_on_error
    def tick(self, tick: LoopTick, time: int, inbox: Inbox, columns: Mapping[str, Cell]) -> None:
        """Record the tick that started at `time` [ns], with additional `columns` of its row."""
        request, result = tick.request, tick.result
        row: dict[str, Cell] = {
            **(_uncontrolled_cells(tick) if result is None else step_cells(result)),
            "t_s": inbox.now if request is None else request.time,
            **columns,
        }
        if result is not None and result.reference is not None:
            row |= zip(_REFERENCE, result.reference[0].tolist(), strict=True)
        self._recorder.send(
            "tick",
            time,
            row,
            measurement=None if request is None else request.measurement,
            plan=None if result is None else result.plan,
            period=self._period,
            diagnose=False,
        )

    @_end_recording_on_error
    def record(self, lines: Sequence[tuple[str, str]], time: int) -> None:
        """Record lines for a replay, each with its topic; the next `tick` writes them."""
        for topic, line in lines:
            if len(line) <= _MAX_LINE_LENGTH:
                self._recorder.prepare("serialized", time, topic, serialize_message(String(data=line)))

    @_end_recording_on_error
    def diagnostics(self, message: DiagnosticArray, time: int) -> None:
        """Record the node's diagnostics, and update the state of the recording."""
        self._recorder.send("serialized", time, DIAGNOSTICS, serialize_message(message))
        self._recorder.poll()
        self._warn()

    @_end_recording_on_error
    def close(self) -> None:
        """Close the file after the last command."""
        self._recorder.close(_TIMEOUT)
        self._warn()

    def abandon(self, fault: str) -> None:
        """End the recording because of a fault."""
        self._recorder.fault = self._recorder.fault or fault
        self._warn()

    def _warn(self) -> None:
        if self._recorder.fault and not self._has_warned:
            self._has_warned = True
            self._logger.warning(f"recording has ended: {self._recorder.fault}; the robot is not affected")


def _uncontrolled_cells(tick: LoopTick) -> dict[str, Cell]:
    """Return the columns of a row for a tick without a controller step."""
    v, omega = tick.command.tolist()
    texts: dict[str, Cell] = {"mode": tick.mode, "message": tick.message, "solver_status": "", "solver_path": "none"}
    return {"v_ref_m_s": v, "omega_ref_rad_s": omega, **texts}


def _metadata(settings: NodeSettings, config: ControllerConfig) -> Metadata:
    """Collect the metadata of a drive by record name."""
    try:
        release = version("diffdrive-mpc")
    except PackageNotFoundError:
        release = "not installed"
    plain = config.model_dump(mode="json")
    record = {
        "version": release,
        "recorded_by": "node",
        "model": Path(config.model).stem,
        "trajectory": settings.trajectory,
    }
    return {
        "case": record | {"trajectory": settings.trajectory},
        "node": {"yaml": yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False)},
        "configuration": {"yaml": yaml.safe_dump(plain, sort_keys=False, allow_unicode=True)},
        "model": {"yaml": model_path(config.model).read_text(encoding="utf-8")},
    }


class TickRecords:
    """Builder of the records of drives and ticks, from which external recorders can replay a drive.

    Parameters
    ----------
    controller
        Controller of the node.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._number = 0
        self._last_drive: tuple[Drive, ControllerConfig] | None = None

    def lines(self, drive: Drive, tick: LoopTick) -> list[tuple[str, str]]:
        """Return the lines to publish for a tick of `drive`, with their topics; the line of a new drive comes first."""
        records = ((DRIVE, self.drive(drive)), (TICK, self.tick(tick)))
        return [(topic, record.line()) for topic, record in records if record is not None]

    def drive(self, drive: Drive) -> DriveRecord | None:
        """Return the record of `drive`; None if drive and configuration are those of the last call."""
        config = self._controller.config
        if self._last_drive is not None and self._last_drive[0] is drive and self._last_drive[1] is config:
            return None
        is_new_drive = self._last_drive is None or self._last_drive[0] is not drive
        self._last_drive = (drive, config)
        self._number += 1
        reference, values = table_of(drive.reference), config.model_dump(mode="json")
        model = _model_text(config.model)
        return DriveRecord(self._number, is_new_drive, drive.reset, drive.t0, reference, values, model, drive.continues)

    def tick(self, tick: LoopTick) -> TickRecord | None:
        """Build the record of a tick of the last recorded drive; return None if the controller was not called."""
        request, result = tick.request, tick.result
        if request is None or result is None:
            return None
        hold = None if request.hold is None else (request.hold.reason, request.hold.failure)
        solver = result.solver
        # A replay needs 0 iterations for a backend that was stopped without a solution, and otherwise at least 1. A
        # value of 1 also reproduces the unconstrained minimiser.
        is_stopped = solver.status is SolverStatus.TIME_LIMIT
        max_iterations = None if not solver.missed else 0 if is_stopped else max(solver.iterations, 1)
        cells = (str(result.mode), result.message, str(solver.method), result.step_time, max_iterations)
        return TickRecord(request.number, request.time, self._number, request.measurement, hold, result.command, *cells)


def _model_text(model: str) -> str:
    """Read the text of a user's model file; empty for a built-in model."""
    if is_shipped(model):
        return ""
    try:
        return Path(model).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""


class RecordingPart(NodePart):
    """Publication of tick records, and recording of an activation; the last part, since other parts add columns."""

    recording: ActivationRecording | None = None
    records: TickRecords | None = None
    _recorded: Drive | None = None

    def activate(self) -> None:
        """Start a recording if it is enabled."""
        tools = self.require_active()[1]
        self.records, self._recorded = TickRecords(tools.controller), None
        self.recording = self._start_recording(tools) if tools.settings.record else None

    def after_tick(self, tick: LoopTick, time: int, row: dict[str, Cell]) -> None:
        """Publish and record the tick."""
        loop, tools = self.require_active()
        drive, recording = loop.drive, self.recording
        if drive is not None and drive is not self._recorded:
            self._recorded = drive
            if recording is not None:
                recording.reference(drive, time)
        if drive is not None and (tools.publishers.has_recorder or recording is not None):
            self._publish(drive, tick, time)
        if recording is not None:
            recording.tick(tick, time, loop.inbox, row)

    def deactivate(self) -> None:
        """End the recording."""
        if self.recording is not None:
            self.recording.close()
            self.recording = None

    def diagnostics(self) -> Mapping[str, str]:
        """Return the state of the recording."""
        return {} if self.recording is None else {"recording": self.recording.status}

    @property
    def fault(self) -> str:
        """Reason why the recording is incomplete; empty if it is complete."""
        recording = self.recording
        return f"recording: {recording.status}" if recording is not None and recording.incomplete else ""

    def after_diagnostics(self, message: DiagnosticArray, time: int) -> None:
        """Record the diagnostics message."""
        if self.recording is not None:
            self.recording.diagnostics(message, time)

    def _start_recording(self, tools: NodeTools) -> ActivationRecording | None:
        """Start the recording of this activation; log a warning and return None if it cannot be started."""
        try:
            # The namespace separates the files of robots that are activated in the same second.
            folder = tools.settings.record_folder + self.node.get_namespace().rstrip("/")
            settings = tools.settings.model_copy(update={"record_folder": folder})
            return ActivationRecording(settings, tools.controller.config, tools.inbox.frame, self.node.get_logger())
        except Exception as error:  # a failed recording must not stop the robot
            self.node.get_logger().warning(f"nothing is recorded: {error}")
            return None

    def _publish(self, drive: Drive, tick: LoopTick, time: int) -> None:
        """Publish and record the replay data of the tick; after an error, no further data are published."""
        if self.records is None or self.tools is None:
            return
        try:
            lines = self.records.lines(drive, tick)
            self.tools.publishers.record(lines)
            if self.recording is not None:
                self.recording.record(lines, time)
        except Exception as error:
            self.records = None
            message = f"later ticks cannot be replayed: {type(error).__name__}: {error}"
            self.node.get_logger().warning(message)
