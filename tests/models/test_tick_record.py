"""Records of ticks and drives survive the way through a line, bit for bit."""

import json

import numpy as np
import pytest

from diffdrive_mpc.models.interface import Measurement, Stamped
from diffdrive_mpc.models.logs.tick_record import DriveRecord, TickRecord, TickRecordError

POSE = Stamped(np.array([0.1, -1 / 3, 3.1]), 12.3456789012345, np.diag([1e-5, 2e-5, 3e-7]))


@pytest.mark.parametrize("hold", [None, ("paused", False), ("odometry is 0.30 s old", True)])
def test_a_tick_reads_back(hold):
    measurement = Measurement(POSE, Stamped((0.5, 0.1 + 0.2), 12.5), Stamped(-0.7, 12.49))
    record = TickRecord(7, 12.6, 2, measurement, hold, np.array([0.3, 1e-17]), "TRACKING", 'a, "b"', "unlimited", 1e-4)
    again = TickRecord.read(record.line())
    assert (again.number, again.time, again.drive, again.hold) == (7, 12.6, 2, hold)
    assert np.array_equal(again.command, record.command)
    assert (again.mode, again.message, again.solver_path) == ("TRACKING", 'a, "b"', "unlimited")
    for name in ("pose", "wheel_twist", "yaw_rate"):
        was, found = getattr(measurement, name), getattr(again.measurement, name)
        assert found.time == was.time and np.array_equal(found.value, was.value)
        assert (found.covariance is None) == (was.covariance is None)
    assert np.array_equal(again.measurement.pose.covariance, POSE.covariance)
    nothing = TickRecord(1, 0.0, 1, Measurement(), None, np.zeros(2), "STOPPED", "", "none", 0.0)
    assert TickRecord.read(nothing.line()).measurement == Measurement()


def test_a_drive_reads_back():
    record = DriveRecord(3, True, False, 1 / 3, {"name": "s", "breaks": [0.0]}, {"horizon": 30}, "kind: sm\n")
    assert DriveRecord.read(record.line()) == record


@pytest.mark.parametrize("line", ["", "[1]", "{}", json.dumps({"format": 99}), json.dumps({"format": 1})])
def test_other_lines_are_refused_with_a_reason(line):
    for kind in (TickRecord, DriveRecord):
        with pytest.raises(TickRecordError):
            kind.read(line)
