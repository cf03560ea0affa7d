"""Logs survive the way to a file and back."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from log_parts import read_columns
from loop_parts import ConstantTwist, FeedForward, KinematicPlant

from diffdrive_mpc import ConfigError, Controller, Measurement, Stamped, load_config
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.sim import Run, simulate
from diffdrive_mpc.sim.log_csv import write_log


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
    log = read_columns(tmp_path / "run.csv")
    assert tuple(log) == tuple(run.columns)
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
    assert np.array_equal(log["true_lateral_m_s"], run.true_twist[:, 1])
    assert np.array_equal(log["reference_y_m"], run.reference_pose[:, 1])
    assert np.array_equal(log["reference_omega_rad_s"], run.reference_twist[:, 1])
    assert np.isnan(log["estimate_v_m_s"]).all()
    assert np.array_equal(log["step_time_s"], run.step_time)
    assert log["mode"] == ["TRACKING"] * run.time.size
    assert log["solver_path"] == ["none"] * run.time.size
    assert log["solver_status"] == [""] * run.time.size


def test_a_log_of_our_controller_holds_what_it_believed_and_how_it_solved(tmp_path: Path) -> None:
    reference = ConstantTwist(0.3, 0.7, 1.0)
    controller = Controller(load_config("ssm", {"sample_time": SparsePlant.sample_time}))
    run = simulate(controller, SparsePlant(0.01, seed=1), reference)
    write_log(run, tmp_path / "run.csv")
    log = read_columns(tmp_path / "run.csv")
    pose = np.column_stack([log["estimate_x_m"], log["estimate_y_m"], log["estimate_theta_rad"]])
    assert np.linalg.norm(pose[20:, :2] - run.true_pose[20:, :2], axis=1).max() < 0.03
    assert np.array_equal(pose, run.estimates[:, :3])
    assert np.array_equal(log["estimate_omega_rad_s"], run.estimates[:, 4])
    assert ((log["estimate_x_sd_m"] > 0.0) & (log["estimate_x_sd_m"] < 0.02))[10:].all()
    assert set(log["solver_status"]) == {"solved"}
    assert log["message"] == list(run.messages)




def test_a_log_replaces_a_file_and_keeps_its_permissions(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("old")
    path.chmod(0o640)
    write_log(run, path)
    assert read_columns(path)["t_s"].size == run.time.size
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


def test_a_link_to_a_file_stays_a_link(run: Run, tmp_path: Path) -> None:
    (tmp_path / "link.csv").symlink_to(tmp_path / "real.csv")
    for _ in range(2):  # first the file is missing, then it is replaced
        write_log(run, tmp_path / "link.csv")
        assert (tmp_path / "link.csv").is_symlink()
        assert read_columns(tmp_path / "real.csv")["t_s"].size == run.time.size


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _device(path: Path) -> None:
    path.symlink_to("/dev/null")


@pytest.mark.parametrize("make", [Path.mkdir, _pipe, _device])
def test_only_a_regular_file_is_replaced(run: Run, tmp_path: Path, make: Callable[[Path], None]) -> None:
    path = tmp_path / "run.csv"
    make(path)
    before = path.lstat()
    with pytest.raises(ConfigError, match=r"run\.csv: not a regular file"):
        write_log(run, path)
    assert path.lstat() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.csv"]


def test_links_in_a_circle_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    with pytest.raises(ConfigError, match=f"^{tmp_path / 'a'}: "), whole_file(tmp_path / "a"):
        pass


def test_what_cannot_be_written_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(ConfigError, match="cannot be written to"), whole_file(tmp_path / "taken" / "run.csv"):
        pass
    assert (tmp_path / "taken").read_text() == "a file"


def test_a_failure_leaves_the_old_file_and_no_new_folder(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("old")
    for path in (tmp_path / "run.csv", tmp_path / "new" / "folder" / "run.csv"):
        with pytest.raises(ZeroDivisionError), whole_file(path) as draft:
            draft.write_text("half")
            raise ZeroDivisionError
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.csv"]
    assert (tmp_path / "run.csv").read_text() == "old"
