"""Verdict of an identification: results of the trial drives, and objections from the logs."""

import re
from dataclasses import replace

import numpy as np
import pytest
from log_parts import MAPPING, drive, write_csv, write_mapping
from typer.testing import CliRunner

from diffdrive_mpc import identify, load_config
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.app.identification import trial_drives
from diffdrive_mpc.app.identification import verdict as verdicts
from diffdrive_mpc.app.identification.trial_drives import HELD_OUT, ITSELF, PATHS, StandIn, trial_settings
from diffdrive_mpc.app.identification.unexplained_motion import identified_robot, unexplained_motion
from diffdrive_mpc.app.identification.verdict import judge_by_drives, remedies
from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.doubt import VERDICTS, Doubt
from diffdrive_mpc.models.identification.deliver.trust import judge
from diffdrive_mpc.sim.plants.model_plant import ModelPlant
from diffdrive_mpc.sim.plants.surface import load_surface

TRACK = "wheels: {track: 0.5}\n"


def identify_columns(folder, columns, mapping=MAPPING + TRACK):
    return identify(write_csv(folder / "drive.csv", columns), mapping=write_mapping(folder / "map.yaml", mapping))


@pytest.fixture(scope="module")
def identification(tmp_path_factory):
    """Identification of a log without objections."""
    return identify_columns(tmp_path_factory.mktemp("sound"), drive(seconds=40.0))


@pytest.fixture(scope="module")
def valid(identification):
    return judge_by_drives(identification)


def test_valid_log_gives_yes_with_error_bounds_that_its_drives_satisfy(identification, valid):
    assert valid.grade == "Yes" and valid.reasons == () and valid.identification is identification
    assert [(drive.plant, drive.path) for drive in valid.drives] == [(p, s) for p in (ITSELF, HELD_OUT) for s in PATHS]
    drives = (*(drive for drive in valid.drives if drive.path in trial_settings().curved), *valid.unexplained)
    lateral, position = (float(size) for size in re.findall(r"([\d.]+) cm", valid.promise))
    assert len(valid.unexplained) == trial_settings().unexplained
    assert lateral >= 100 * max(drive.metrics.lateral_max_m for drive in drives) > 0.3 * lateral
    assert position >= 100 * max(drive.metrics.position_max_m for drive in drives) > 0.3 * position


def with_held_out(identification, **changes):
    """Return the identification with changes of its held-out record."""
    report, data = identification.report, identification.report.data
    data = replace(data, validation=(replace(data.validation[0], **changes),))
    return replace(identification, report=replace(report, data=data))


def move_held_out_poses(identification, motion):
    """Return the identification with held-out poses moved by `motion(time, left)`, complex [m]."""
    (record,) = identification.report.data.validation
    offset = motion(record.time - record.start, 1j * np.exp(1j * record.pose[:, 2]))
    shift = np.column_stack([offset.real, offset.imag, 0.0 * offset.real])
    return with_held_out(identification, pose=record.pose + shift)


def unexplained_with(identification, motion):
    return unexplained_motion(move_held_out_poses(identification, motion))


def test_unexplained_motion_contains_slides_but_no_pose_noise_or_slip_by_traction(identification):
    (original,), slip, *_ = unexplained_motion(identification)
    (outputs,), dt = identification.report.fitted.simulated, identification.report.data.validation[0].dt
    (slide,), *_ = unexplained_with(identification, lambda time, left: 0.05 * dt * np.cumsum(left))
    assert (slide - original)[np.any(slide != 0.0, axis=1)].mean(axis=0) == pytest.approx([0.0, 0.05, 0.0], abs=0.005)
    noise = np.array([1, 1j]) @ np.random.default_rng(0).normal(0.0, 0.02, (2, 100_000))
    (noisy,), _, displacement, _ = unexplained_with(identification, lambda time, _: noise[: len(time)])
    # Displacements over one second would give 28 mm/s.
    assert np.std(noisy[:, 1]) < 0.015 and displacement < 0.02 / 2
    _, _, fast, _ = unexplained_with(identification, lambda time, left: 0.005j * left * np.sign(np.sin(6.0 * time)))
    assert fast == pytest.approx(0.005, rel=0.15)
    speed = 0.05 * np.abs(outputs[:, 1]) * np.gradient(outputs[:, 0], dt)
    (motion,), new_slip, *_ = unexplained_with(identification, lambda _, left: 1j * dt * np.cumsum(speed * left))
    assert new_slip - slip == pytest.approx(0.05, rel=0.1)
    assert motion[:, 0] == pytest.approx(original[:, 0], abs=0.002)


def test_yaw_slip_that_grows_with_the_speed_is_repeated_and_not_random(identification, valid):
    (record,), (outputs,) = identification.report.data.validation, identification.report.fitted.simulated
    v, omega = outputs.T
    changes = {"yaw_rate": record.yaw_rate + omega * (0.2 - 0.5 * v**2), "pose": None, "fresh_pose": None}
    robot = identified_robot(with_held_out(identification, **changes), valid.config)
    assert robot.yaw_slip == pytest.approx((0.2, -0.5), abs=0.02)
    assert np.max(robot.variance[2]) < 1e-3


@pytest.mark.parametrize("yaw", ["gyro", "encoders"])
def test_robot_of_a_log_without_poses_rests_and_its_encoders_measure_its_motion(identification, valid, yaw):
    without_poses = with_held_out(identification, pose=None, fresh_pose=None)
    report = without_poses.report
    report = replace(report, data=replace(report.data, yaw=yaw))
    robot = identified_robot(replace(without_poses, report=report), valid.config)
    assert robot.on_wheels == (True, yaw == "encoders")
    assert np.all(np.array(robot.variance)[:, 0] == 0.0) and np.any(robot.variance)
    slip, motion = load_surface("default").slip, robot.disturbance(valid.config.sample_time, np.random.default_rng(0))
    plant = ModelPlant(identification.model, slip, robot.sensors, disturbance=motion)
    for command in [0.0, 0.5]:
        for _ in range(20):
            plant.advance([command, command])
        assert np.any(plant.true_pose) == (command > 0.0)


@pytest.mark.system
def test_sliding_robot_has_larger_error_bounds_and_needs_care(identification):
    """The sideways speed changes its sign every two seconds."""

    def slide_sideways(time, left):
        return np.cumsum(0.08 * np.sign(np.sin(0.5 * np.pi * time)) * left) * (time[1] - time[0])

    rejected = judge_by_drives(move_held_out_poses(identification, lambda *pose: 8.0 * slide_sideways(*pose)))
    assert rejected.grade == "No" and "arrive: record slower drives, with" in rejected.failure and not rejected.promise
    verdict = judge_by_drives(move_held_out_poses(identification, slide_sideways))
    assert verdict.grade == "With care" and any("leaves its path" in reason for reason in verdict.reasons)
    assert 0.03 < verdict.performance.lateral < 0.3


@pytest.mark.usefixtures("one_path")
def test_robot_with_late_poses_arrives(tmp_path):
    columns = drive(seconds=40.0)
    late = {name: np.concatenate([np.full(15, columns[name][0]), columns[name][:-15]]) for name in ("x", "y", "theta")}
    identification = identify_columns(tmp_path, columns | late)
    delay, default = identification.config["sensors"]["pose"]["delay"], load_config("sm")
    assert delay == pytest.approx(0.3, abs=0.01)
    assert identification.config["estimator"]["history"] == pytest.approx(delay + default.estimator.history)
    assert identification.config["failure"]["max_pose_age"] == pytest.approx(delay + default.failure.max_pose_age)
    assert not judge_by_drives(identification).failure


def test_unexplained_motion_of_short_stretches_is_known(tmp_path):
    columns = drive(seconds=40.0)
    columns["part"] = np.arange(len(columns["t"])) // 80
    identification = identify_columns(tmp_path, columns, f"{MAPPING}  segment: part\n{TRACK}")
    motion, *_ = unexplained_motion(identification)
    assert list(map(len, motion)) == [len(record.time) for record in identification.report.data.validation]


@pytest.fixture
def one_path(monkeypatch):
    """Drive only the first path, because failing drives take long."""
    monkeypatch.setattr(trial_drives, "PATHS", PATHS[:1])


@pytest.mark.system
@pytest.mark.usefixtures("one_path")
@pytest.mark.parametrize("share", [0.3, 0.2])
def test_limits_are_lowered_until_the_drives_pass(identification, share, monkeypatch):
    clipped = BaseEffects(twist_range={"omega": share * identification.config["limits"]["omega"]})
    monkeypatch.setattr(verdicts, "stand_ins", lambda _: [StandIn(HELD_OUT, identification.model, clipped)])
    verdict = judge_by_drives(identification)
    assert verdict.grade == "With care" and not verdict.failure
    original, reduced = identification.config["limits"], verdict.identification.config["limits"]
    assert reduced["omega"] < original["omega"] and reduced["predicted_omega"] < original["predicted_omega"]
    assert all(drive.passed for drive in verdict.drives)
    assert any("limits.omega reduced to" in reason for reason in verdict.reasons)
    assert "faster trial drives failed" in verdict.identification.configuration.text()


@pytest.mark.long
@pytest.mark.usefixtures("one_path")
def test_configuration_is_not_written_if_no_stand_in_drives(tmp_path, monkeypatch):
    """The robot hardly turns: exit code 2 and only the report; --force writes the unchanged configuration."""

    def reduce_turning(identified):
        model = replace(identified.model, C=identified.model.C * np.array([[1.0], [0.1]]))
        return [StandIn(HELD_OUT, model, BaseEffects())]

    monkeypatch.setattr(verdicts, "stand_ins", reduce_turning)
    # Failing drives take long: only the lowest limits are tried.
    slowest = trial_drives.trial_settings().model_copy(update={"shares": trial_drives.trial_settings().shares[-1:]})
    monkeypatch.setattr(verdicts, "trial_settings", lambda: slowest)
    log = write_csv(tmp_path / "a.csv", drive(seconds=20.0))
    mapping = write_mapping(tmp_path / "m.yaml", MAPPING + TRACK)
    arguments = ["identify", str(log), "--mapping", str(mapping), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2 and "fails on 'circle'" in result.stderr and result.stderr.count("error: ") == 1
    assert not (tmp_path / "out" / "config.yaml").exists() and not (tmp_path / "out" / "model.yaml").exists()
    assert "May I drive? No: " in (tmp_path / "out" / "report.md").read_text()
    assert "May I drive? No: " in result.stdout and "also with 25 % of the limits" in result.stderr
    result = CliRunner().invoke(app, [*arguments, "--force"])
    assert result.exit_code == 0 and "written because of --force" in result.stdout
    assert (tmp_path / "out" / "config.yaml").exists()


@pytest.mark.parametrize(
    ("doubts", "grade", "reason"),
    [
        ([], "Yes", ""),
        ([Doubt("divided lag", "x")], "Yes", ""),
        ([Doubt("gain", "x"), Doubt("gain", "y")], "With care", "2 warnings matter (gain)"),
        ([Doubt("lag", "x"), Doubt("pose point", "y")], "With care", "2 warnings matter (lag, pose point)"),
    ],
)
def test_matching_warnings_prevent_a_yes(identification, doubts, grade, reason):
    trust = judge(identification.report.data, identification.report.fitted, doubts)
    assert (trust.grade, "; ".join(trust.reasons)) == (grade, reason)


@pytest.mark.parametrize(("fit", "grade"), [(95.0, "Yes"), (39.0, "No"), (16.0, "No"), (float("nan"), "No")])
def test_poor_fit_gives_no(identification, fit, grade):
    fitted = identification.report.fitted
    poor_fit = replace(fitted, validation=replace(fitted.validation, fit_percent=np.array([fit, 95.0])))
    assert judge(identification.report.data, poor_fit, []).grade == grade


def test_unknown_delay_gives_no(identification):
    fitted = identification.report.fitted
    parameters = fitted.identified.parameters
    scale = np.where([name.startswith("omega") for name in parameters.names], 300.0, 1.0)
    uncertain = replace(parameters, covariance=parameters.covariance * np.outer(scale, scale))
    fitted = replace(fitted, identified=replace(fitted.identified, parameters=uncertain))
    trust = judge(identification.report.data, fitted, [])
    assert trust.grade == "No" and "the delay of omega is unknown" in trust.reasons[0]


def test_every_kind_of_warning_has_a_remedy():
    assert set(remedies()) == set(VERDICTS)
