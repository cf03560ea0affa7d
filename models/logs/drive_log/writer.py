"""Writer of the ticks of a drive to an MCAP file, with the topics of node and robot."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import IO, Any

from diffdrive_mpc.models.interface import FloatArray, Measurement, Stamped
from diffdrive_mpc.models.logs.drive_log import ros_messages as ros
from diffdrive_mpc.models.logs.drive_log import topics as topic
from diffdrive_mpc.models.logs.drive_log.tick import (
    TickRow,
    error_cells,
    measured_cells,
    measurement_of,
    numbers,
    tick_schema,
    to_json,
)

_NANO = 10**9
_NORMAL_MODES = ("TRACKING", "FINISHED", "IDLE")
_CHUNK = 1 << 18
"""Chunk size [bytes]. A truncated file loses at most one chunk, some seconds of data."""


class DriveWriter:
    """Writer of one drive; `close` completes the file.

    Parameters
    ----------
    stream
        Target stream; it is not closed.
    metadata
        Information about the drive: values by key, by name of the metadata record.
    frame
        Frame of poses, plan and reference.
    pose_topic
        True if the measured poses come from a separate sensor; False if they are odometry.
    """

    def __init__(
        self,
        stream: IO[bytes],
        metadata: Mapping[str, Mapping[str, str]],
        *,
        frame: str = topic.MAP,
        pose_topic: bool = True,
    ) -> None:
        from mcap.writer import Writer  # noqa: PLC0415 - not needed for --help

        self._frame, self._pose_topic = frame, pose_topic
        self._writer = Writer(stream, chunk_size=_CHUNK)
        self._writer.start(profile="ros2", library="diffdrive-mpc")
        for name, entries in metadata.items():
            self._writer.add_metadata(name, dict(entries))
        self._writer.add_metadata("layout", {"frame": frame, "poses": "sensor" if pose_topic else "odometry"})
        self._channels: dict[str, int] = {}
        self._kinds: dict[str, int] = {}
        # Initial values with which the first tick writes mode and status.
        self._last_mode, self._diagnostic_time = "", -_NANO

    def close(self) -> None:
        """Write the index; without it, the file can only be read sequentially."""
        self._writer.finish()  # type: ignore[no-untyped-call]

    def tick(
        self,
        now: int,
        row: TickRow,
        *,
        measurement: Measurement | None = None,
        plan: FloatArray | Sequence[Sequence[float]] | None = None,
        period: int = 0,
        odometry_pose: Sequence[float] | None = None,
        diagnose: bool = True,
    ) -> None:
        """Write one tick.

        Parameters
        ----------
        now
            Time of the tick on the file's clock [ns].
        row
            Row of the tick; `t_s` is the same time in seconds.
        measurement
            Input of the controller, if the row does not contain it.
        plan, period
            (N + 1, 3) predicted poses from `now` on, and the time between them [ns].
        odometry_pose
            (3,) pose of the odometry, if it differs from the measured pose.
        diagnose
            True to write a status once per second; False for a node, which publishes its own status.
        """
        measured = {} if measurement is None else measured_cells(measurement)
        row = {**row, **measured, **error_cells(row)}
        self._write(topic.STATE, now, to_json(row))
        self._message(topic.COMMAND, now, ros.command(now, _numbers(row, "v_ref_m_s", "omega_ref_rad_s")))
        self._readings(now, row, odometry_pose)
        self._truth(now, row)
        self._estimate(now, row)
        if plan is not None and len(plan):
            poses = plan.tolist() if hasattr(plan, "tolist") else plan
            stamps = [now + index * period for index in range(len(poses))]
            self._message(topic.PLAN, now, ros.path(now, stamps, poses, self._frame))
        if diagnose and now - self._diagnostic_time >= _NANO:
            self._diagnostic_time = now
            self._message(topic.DIAGNOSTICS, now, _status(now, row))

    def reference(self, now: int, stamps: Sequence[int], poses: FloatArray) -> None:
        """Write the reference path (n, 3) and its time stamps (n,) [ns]."""
        self._message(topic.REFERENCE, now, ros.path(now, stamps, poses.tolist(), self._frame))

    def serialized(self, now: int, name: str, data: bytes) -> None:
        """Write a CDR-serialised message of the topic `name`."""
        self._write(name, now, data)

    def _readings(self, now: int, row: TickRow, odometry_pose: Sequence[float] | None) -> None:
        """Write the sensor readings, stamped with the time of measurement."""
        measured = measurement_of(row)

        def stamp(reading: Stamped) -> int:
            # The clock of the file may differ from the controller's clock, so only time differences are used.
            return now + round(_NANO * (reading.time - float(row["t_s"])))

        pose, wheels, gyro, speeds = measured.pose, measured.wheel_twist, measured.yaw_rate, measured.wheel_speeds
        if wheels is not None:
            place = pose.value if pose is not None and not self._pose_topic else odometry_pose
            self._message(topic.ODOMETRY, now, ros.odometry(stamp(wheels), place, wheels))
        if gyro is not None:
            self._message(topic.IMU, now, ros.imu(stamp(gyro), gyro))
        if pose is not None and self._pose_topic:
            self._message(topic.POSE, now, ros.sensed_pose(stamp(pose), pose))
        if speeds is not None:
            self._message(topic.JOINTS, now, ros.joint_state(stamp(speeds), speeds))
        if battery := _numbers(row, "battery_voltage_v", "battery_current_a"):
            self._message(topic.BATTERY, now, ros.battery_state(now, *battery))
        if motors := _numbers(row, "motor_fl_a", "motor_fr_a", "motor_rl_a", "motor_rr_a"):
            self._message(topic.MOTORS, now, ros.motor_currents(motors))

    def _truth(self, now: int, row: TickRow) -> None:
        if pose := _numbers(row, "true_x_m", "true_y_m", "true_theta_rad"):
            self._message(topic.TRUE_POSE, now, ros.pose(now, pose, topic.MAP))
        if twist := _numbers(row, "true_v_m_s", "true_lateral_m_s", "true_omega_rad_s"):
            self._message(topic.TRUE_TWIST, now, ros.true_twist(now, twist))

    def _estimate(self, now: int, row: TickRow) -> None:
        """Write the estimated pose, the tracking error and the mode."""
        pose = _numbers(row, "estimate_x_m", "estimate_y_m", "estimate_theta_rad")
        if pose:
            self._message(topic.TRANSFORMS, now, ros.transform(now, pose, self._frame))
        if error := _numbers(row, "error_along_m", "error_across_m", "error_heading_rad"):
            self._message(topic.ERROR, now, ros.vector(now, error))
        mode, message = str(row["mode"]), str(row["message"])
        if mode != self._last_mode:
            self._last_mode = mode
            self._message(topic.MODE, now, ros.text(f"{mode}: {message}" if message else mode))

    def _message(self, name: str, now: int, message: ros.Message) -> None:
        self._write(name, now, ros.serialize(topic.KINDS[name], message))

    def _write(self, name: str, now: int, data: bytes) -> None:
        channel = self._channels.get(name)
        if channel is None:
            channel = self._channels[name] = self._channel(name)
        self._writer.add_message(channel, log_time=now, data=data, publish_time=now)

    def _channel(self, name: str) -> int:
        if name == topic.STATE:
            schema = self._writer.register_schema(
                "diffdrive_mpc.State", "jsonschema", json.dumps(tick_schema()).encode()
            )
            return self._writer.register_channel(name, "json", schema)
        kind = topic.KINDS[name]
        if kind not in self._kinds:
            self._kinds[kind] = self._writer.register_schema(kind, "ros2msg", _definition(kind))
        return self._writer.register_channel(name, "cdr", self._kinds[kind])


@contextmanager
def drive_writer(path: Path, metadata: Mapping[str, Mapping[str, str]], **options: Any) -> Iterator[DriveWriter]:  # noqa: ANN401
    """Yield a writer of a new file with `options` of `DriveWriter`; complete the file unless an error is raised."""
    with path.open("wb") as stream:
        writer = DriveWriter(stream, metadata, **options)
        yield writer
        writer.close()


@cache
def _definition(kind: str) -> bytes:
    return ros.definition(kind)


def _numbers(row: TickRow, *names: str) -> list[float]:
    return numbers(row, names)


def _status(now: int, row: TickRow) -> ros.Message:
    mode, message = str(row["mode"]), str(row["message"])
    level = 0 if mode in _NORMAL_MODES and not message else 2 if mode in ("BRAKING", "STOPPED", "FAULT") else 1
    values = {
        "mode": mode,
        "solver": f"{row['solver_status']}, {row['solver_path']}, {row.get('solver_iterations', 0):.0f} iterations",
        "step time [ms]": f"{1e3 * step:.2f}" if isinstance(step := row.get("step_time_s"), float) else "-",
    }
    return ros.diagnostics(now, level, f"{mode}: {message}" if message else mode, values)
