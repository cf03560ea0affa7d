"""Recorder that passes ticks to a separate process, without waiting or raising errors."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest

from diffdrive_mpc import Measurement, Stamped
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.logs.drive_log.reader import read_drive_log
from diffdrive_mpc.models.logs.drive_log.recorder import DriveRecorder
from diffdrive_mpc.models.logs.tick_record import DriveRecord, TickRecord, TickRecordError
from processes import is_running

TIMEOUT = 60.0
PERIOD = 20_000_000


def row(k):
    texts = {"mode": "TRACKING", "message": "", "solver_status": "", "solver_path": "none"}
    return {"t_s": 0.02 * k, "v_ref_m_s": 0.1 * (k % 7), "omega_ref_rad_s": 0.01 * k, **texts}


def record_tick(recorder, k):
    speed = Stamped(np.array([0.1 * (k % 7), 0.0]), 0.02 * k - 0.003)
    plan = np.full((31, 3), float(k))
    recorder.send(
        "tick", 10**9 + k * PERIOD, row(k), measurement=Measurement(wheel_twist=speed), plan=plan, period=PERIOD
    )


@contextmanager
def file_size_limit(size):
    """Limit the files of processes that start in the context to `size` bytes, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def recorder_in(folder, **options):
    result = DriveRecorder(folder / "drive.mcap", {"case": {"model": "sm"}}, timeout=TIMEOUT, **options)
    assert not result.fault
    return result


def test_recorded_file_contains_all_passed_rows(tmp_path):
    recorder = recorder_in(tmp_path / "new", frame="odom", pose_topic=False)
    for k in range(300):
        record_tick(recorder, k)
    recorder.close(TIMEOUT)
    assert not recorder.fault and not recorder.lost
    log = read_drive_log(recorder.path, plans=True)
    assert not log.cut and not log.pose_sensor and log.metadata["case"] == {"model": "sm"}
    assert list(log.columns["v_ref_m_s"]) == [0.1 * (k % 7) for k in range(300)]
    assert list(log.columns["wheel_t_s"]) == [0.02 * k - 0.003 for k in range(300)]
    assert np.array_equal([plan[0, 0] for plan in log.plans], np.arange(300.0))
    assert read_log(recorder.path).records[0].twist is not None


def test_existing_file_is_not_replaced(tmp_path):
    (tmp_path / "drive.mcap").write_bytes(b"mine")
    recorder = recorder_in(tmp_path)
    record_tick(recorder, 0)
    recorder.close(TIMEOUT)
    assert recorder.path == tmp_path / "drive-1.mcap" and len(read_drive_log(recorder.path).rows) == 1
    assert (tmp_path / "drive.mcap").read_bytes() == b"mine"


def test_full_disk_ends_the_recording_and_preserves_the_written_part(tmp_path):
    with file_size_limit(300_000):
        recorder = recorder_in(tmp_path)
    k, deadline = 0, time.monotonic() + TIMEOUT
    while not recorder.fault and time.monotonic() < deadline:
        record_tick(recorder, k)
        recorder.poll()
        k += 1
        time.sleep(0.001)
    assert recorder.fault == "File too large"
    record_tick(recorder, k)
    recorder.close(TIMEOUT)
    log = read_drive_log(recorder.path)
    assert log.cut and 0 < len(log.rows) <= k


def test_folder_that_cannot_be_created_is_a_fault_without_exception(tmp_path):
    (tmp_path / "file").touch()
    recorder = DriveRecorder(tmp_path / "file" / "drive.mcap", {}, timeout=TIMEOUT)
    assert recorder.fault in ("Not a directory", "File exists")
    record_tick(recorder, 0)
    recorder.close(TIMEOUT)


def test_stopped_writer_causes_lost_ticks_without_delay(tmp_path):
    recorder = recorder_in(tmp_path)
    writer = recorder._process.pid
    os.kill(writer, signal.SIGSTOP)
    try:
        k = 0
        while not recorder.lost and k < 100_000:  # more than any system buffers
            record_tick(recorder, k)
            k += 1
    finally:
        os.kill(writer, signal.SIGCONT)
    assert recorder.lost == 1
    recorder.close(TIMEOUT)
    log = read_drive_log(recorder.path)
    assert not log.cut and list(log.columns["t_s"]) == [0.02 * tick for tick in range(k - 1)]


KILLED_RECORDER = """
import os, sys
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from test_drive_recorder import record_tick, recorder_in
recorder = recorder_in(Path(sys.argv[1]))
for k in range(100):
    record_tick(recorder, k)
print(recorder._process.pid, flush=True)
os.kill(os.getpid(), 9)
"""


def test_file_is_complete_if_the_recording_process_is_killed(tmp_path):
    arguments = [sys.executable, "-c", KILLED_RECORDER, str(tmp_path), *sys.path]
    completed = subprocess.run(arguments, capture_output=True, text=True, check=False, timeout=TIMEOUT)
    assert completed.returncode == -signal.SIGKILL, completed.stderr
    deadline = time.monotonic() + TIMEOUT
    while is_running(int(completed.stdout)) and time.monotonic() < deadline:
        time.sleep(0.01)
    log = read_drive_log(tmp_path / "drive.mcap")
    assert not log.cut and len(log.rows) == 100


def test_file_of_a_killed_writer_is_read_up_to_its_end(tmp_path):
    recorder = recorder_in(tmp_path)
    k, deadline = 0, time.monotonic() + TIMEOUT
    while recorder.path.stat().st_size < 20_000 and time.monotonic() < deadline:
        record_tick(recorder, k)
        k += 1
        time.sleep(0.001)
    recorder._process.kill()
    recorder._process.wait()
    record_tick(recorder, k)
    assert recorder.fault == "the writing process has ended"
    recorder.close(TIMEOUT)
    log = read_drive_log(recorder.path)
    assert log.cut and 0 < len(log.rows) <= k


POSE = Stamped(np.array([0.1, -1 / 3, 3.1]), 12.3456789012345, np.diag([1e-5, 2e-5, 3e-7]))


@pytest.mark.parametrize("hold", [None, ("paused", False), ("odometry is 0.30 s old", True)])
def test_parsed_tick_equals_the_written_tick(hold):
    measurement = Measurement(POSE, Stamped((0.5, 0.1 + 0.2), 12.5), Stamped(-0.7, 12.49))
    record = TickRecord(7, 12.6, 2, measurement, hold, np.array([0.3, 1e-17]), "TRACKING", 'a, "b"', "unlimited", 1e-4)
    parsed = TickRecord.read(record.line())
    assert (parsed.number, parsed.time, parsed.drive, parsed.hold) == (7, 12.6, 2, hold)
    assert np.array_equal(parsed.command, record.command)
    assert (parsed.mode, parsed.message, parsed.solver_path) == ("TRACKING", 'a, "b"', "unlimited")
    for name in ("pose", "wheel_twist", "yaw_rate"):
        original, result = getattr(measurement, name), getattr(parsed.measurement, name)
        assert result.time == original.time and np.array_equal(result.value, original.value)
        assert (result.covariance is None) == (original.covariance is None)
    assert np.array_equal(parsed.measurement.pose.covariance, POSE.covariance)
    empty_record = TickRecord(1, 0.0, 1, Measurement(), None, np.zeros(2), "STOPPED", "", "none", 0.0)
    assert TickRecord.read(empty_record.line()).measurement == Measurement()


def test_parsed_drive_equals_the_written_drive():
    record = DriveRecord(3, True, False, 1 / 3, {"name": "s", "breaks": [0.0]}, {"horizon": 30}, "kind: sm\n")
    assert DriveRecord.read(record.line()) == record


@pytest.mark.parametrize("line", ["", "[1]", "{}", json.dumps({"format": 99}), json.dumps({"format": 1})])
def test_invalid_line_raises_error(line):
    for record_type in (TickRecord, DriveRecord):
        with pytest.raises(TickRecordError):
            record_type.read(line)
