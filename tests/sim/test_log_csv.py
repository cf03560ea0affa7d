"""Logs survive the way to a file and back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from loop_parts import ConstantTwist, FeedForward, KinematicPlant

from models.interface import Measurement, Stamped
from sim import Run, simulate
from sim.log_csv import COLUMNS, read_log, write_log


class SparsePlant(KinematicPlant):
    """Poses every fifth tick only, one tick late, and all four wheel speeds."""

    def measure(self) -> Measurement:
        full = super().measure()
        tick = round(self.time / self.sample_time)
        pose = Stamped(full.pose.value, full.pose.time - 0.02) if full.pose and tick % 5 == 0 else None
        return Measurement(pose, None, full.yaw_rate, Stamped(self.time + np.arange(4.0), self.time))


@pytest.fixture
def run() -> Run:
    return simulate(FeedForward(), SparsePlant(0.01, seed=1), ConstantTwist(0.3, 0.7, 1.0))


def test_a_log_reads_back_bit_for_bit(run: Run, tmp_path: Path) -> None:
    write_log(run, tmp_path / "run.csv")
    log = read_log(tmp_path / "run.csv")
    assert tuple(log) == COLUMNS
    assert np.array_equal(log["t_s"], run.time)
    assert np.array_equal(np.column_stack([log["v_ref_m_s"], log["omega_ref_rad_s"]]), run.command)
    assert np.array_equal(log["omega_gyro_rad_s"], run.gyro)
    assert np.array_equal(log["wheel_rr_rad_s"], run.wheel_speeds[:, 3])
    assert np.isnan(log["v_wheel_m_s"]).all()
    poses = np.column_stack([log["pose_x_m"], log["pose_y_m"], log["pose_theta_rad"]])
    assert np.array_equal(poses, run.measured_pose, equal_nan=True)
    assert np.isfinite(poses[:, 0]).sum() == 11
    assert log["pose_t_s"][5] == pytest.approx(0.08)
    assert np.array_equal(log["true_theta_rad"], run.true_pose[:, 2])


def test_no_partial_file_stays_behind(run: Run, tmp_path: Path) -> None:
    write_log(run, tmp_path / "run.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["run.csv"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("t_s,", "time,", "column 't_s' is missing"),
        ("0.0,", "zero,", "line 2, column 't_s': 'zero' is no number"),
        ("0.0,", "0.0,0.0,", "line 2: 18 cells, expected 17"),
    ],
)
def test_mistakes_in_a_log_are_named_with_their_place(
    run: Run, tmp_path: Path, old: str, new: str, message: str
) -> None:
    path = tmp_path / "run.csv"
    write_log(run, path)
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        read_log(path)
