"""`diffdrive-mpc excite`: drives for the identification of slip and of models, and their files."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from commands import invoke
from diffdrive_mpc import ConfigError, load_trajectory
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.load import load_linear_model
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.load import load_segments
from diffdrive_mpc_extras.excitation import model_excitation as searched
from diffdrive_mpc_extras.excitation.drive_information import DriveInformation
from diffdrive_mpc_extras.excitation.excite import check_drive, excite_model, simulate_case
from diffdrive_mpc_extras.excitation.model_excitation import Room, model_excitation, path_of, write_model_drive
from diffdrive_mpc_extras.excitation.slip_excitation import max_term_correlation, slip_excitation, write_slip_drive


@pytest.mark.parametrize(
    ("side", "speed", "yaw_rate"), [(3.0, 0.6, 1.0), (6.0, 0.6, 1.0), (6.0, 1.0, 0.5), (20.0, 2.0, 1.0)]
)
def test_slip_excitation_stays_in_the_square_and_separates_the_terms(tmp_path, side, speed, yaw_rate):
    write_slip_drive(tmp_path / "drive.yaml", slip_excitation(side, 60.0, speed, yaw_rate))
    if speed <= 1.5:
        drive = load_trajectory(tmp_path / "drive.yaml")
        pose = drive.sample(np.linspace(0.0, drive.duration, 2000)).pose
        # Smoothing may cut a corner by its tolerance.
        assert np.abs(pose[:, :2]).max() <= 0.5 * side - 0.2
    segments = load_segments(tmp_path / "drive.yaml")
    assert max_term_correlation(segments) < 0.5
    assert max(abs(segment.v) for segment in segments) <= speed + 1e-9
    assert max(abs(segment.omega) for segment in segments) <= yaw_rate + 1e-9


def test_shipped_trajectory_is_the_slip_drive_of_six_metres():
    """The root package ships the sequence that this search finds."""
    shipped, excitation = load_segments("excitation"), slip_excitation(6.0, 90.0, 0.6, 1.0)
    rows = [
        [(segment.v, segment.omega, segment.duration) for segment in segments] for segments in (shipped, excitation)
    ]
    np.testing.assert_allclose(*rows, atol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "message"), [((0.5, 60.0, 0.6, 1.0), "give 2.1 m or more"), ((6.0, 1e9, 0.6, 1.0), "at most 1800 s")]
)
def test_infeasible_slip_excitation_raises_value_error(arguments, message):
    with pytest.raises(ValueError, match=message):
        slip_excitation(*arguments)


def test_command_writes_the_slip_trajectory_and_prints_the_maximum_correlation(tmp_path):
    path = tmp_path / "slip.yaml"
    result = invoke(app, "excite", "--for", "slip", "--side", "5", "--out", path)
    assert "Maximum correlation of the terms v, omega and v omega: 0." in result.output
    assert yaml.safe_load(path.read_text())["timing"] == "smooth"
    invoke(app, "excite", "--for", "mass", "--out", tmp_path / "no.yaml", code=2)
    assert "ends in .yaml or .yml" in invoke(app, "excite", "--out", tmp_path / "no.csv", code=2).stderr
    assert not (tmp_path / "no.yaml").exists()


LIMITS = TrajectoryLimits(v=0.6, omega=1.0, v_acceleration=1.5, omega_acceleration=4.0)
TICK = searched.model_excitation_settings().tick
INFORMATION = DriveInformation(load_linear_model("sm"), (0.01, 0.02))


def objective(twists):
    return INFORMATION.log_determinant(np.repeat(twists, 5, axis=0), TICK / 5)


@settings(deadline=None, max_examples=30)
@given(
    family=st.sampled_from([searched._Steps, searched._Sines]),
    seed=st.integers(0, 2**31),
    length=st.floats(1.2, 8.0),
    width=st.floats(1.2, 8.0),
    seconds=st.floats(10.0, 40.0),
    v=st.floats(0.05, 2.0),
    omega=st.floats(0.1, 3.0),
)
def test_all_members_of_a_family_stay_inside_room_and_limits(family, seed, length, width, seconds, v, omega):
    room, limits = Room(length, width), TrajectoryLimits(v, omega, 1.0, 3.0)
    member = family(room, seconds, limits)
    twists = member.twists(np.random.default_rng(seed).uniform(size=member.genes))
    assert len(twists) == pytest.approx(seconds / TICK, abs=1.01)
    assert (np.abs(twists) <= np.array([v, omega]) + 1e-9).all()
    steps = np.diff(np.vstack([np.zeros(2), twists, np.zeros(2)]), axis=0)
    assert (np.abs(steps) <= TICK * np.array([1.0, 3.0]) + 1e-9).all()
    assert (np.abs(path_of(twists, TICK)[:, :2]) <= room.reach + 1e-6).all()


def test_search_exceeds_random_drives_and_is_reproducible(monkeypatch):
    short = searched.model_excitation_settings().model_copy(update={"population": 8, "generations": 4})
    monkeypatch.setattr(searched, "model_excitation_settings", lambda: short)
    room = Room(4.0, 3.0)
    drive = model_excitation(room, 15.0, LIMITS, objective, seed=3)
    repetition = model_excitation(room, 15.0, LIMITS, objective, seed=3)
    assert np.array_equal(drive.twists, repetition.twists)
    stream = np.random.default_rng(4)
    for name, family in (("steps", searched._Steps), ("multi-sine", searched._Sines)):
        member = family(room, 15.0, LIMITS)
        random_objectives = [objective(member.twists(stream.uniform(size=member.genes))) for _ in range(8)]
        assert drive.objectives[name] > np.median(random_objectives)
    assert objective(drive.twists) == pytest.approx(max(drive.objectives.values()))


def test_trajectory_file_contains_the_drive(tmp_path):
    member = searched._Steps(Room(4.0, 3.0), 20.0, LIMITS)
    twists = member.twists(np.random.default_rng(1).uniform(size=member.genes))
    write_model_drive(tmp_path / "drive.yaml", searched.ModelDrive("steps", twists, {}), TICK)
    drive = load_trajectory(tmp_path / "drive.yaml")
    # The ramps from and to rest take additional time.
    assert drive.duration == pytest.approx(len(twists) * TICK, abs=0.3)
    assert drive.sample([drive.duration]).pose[0] == pytest.approx(path_of(twists, TICK)[-1], abs=5e-3)


@pytest.fixture
def quick(monkeypatch):
    """Short search settings."""
    short = searched.model_excitation_settings().model_copy(update={"population": 6, "generations": 2})
    monkeypatch.setattr(searched, "model_excitation_settings", lambda: short)


def write_robot(path, gain, dead_time):
    channels = {name: {"gain": gain, "natural_frequency": 14.0, "damping": 1.1} for name in ("v", "omega")}
    content = {
        "name": "other",
        "structure": "sm",
        "provenance": {"origin": "assumed", "source": "this test"},
        "dead_time": {"v": dead_time, "omega": dead_time},
        "channels": channels,
    }
    path.write_text(yaml.safe_dump(content))
    return f"model:{path}"


def drive_of(excitation, folder, plant):
    return simulate_case(excitation.on(plant, 1, folder / "drive.yaml"), folder / "drive.yaml")


@pytest.mark.usefixtures("quick")
def test_drive_stays_in_the_room_on_robots_with_other_gains(tmp_path):
    excitation = excite_model("ssm", Room(3.0, 2.0), seconds=20.0)
    excitation.write(tmp_path / "drive.yaml")
    for gain, dead_time in ((0.7, 0.1), (1.3, 0.02)):
        run = drive_of(excitation, tmp_path, write_robot(tmp_path / "other.yaml", gain, dead_time))
        check_drive(run, excitation.room)
        assert (np.abs(run.true_pose[:, :2]) <= (1.5 - 0.1, 1.0 - 0.1)).all()


@pytest.mark.usefixtures("quick")
def test_robot_that_leaves_the_room_raises_config_error(tmp_path):
    excitation = excite_model("ssm", Room(3.0, 2.0), seconds=10.0)
    excitation.write(tmp_path / "drive.yaml")
    run = drive_of(excitation, tmp_path, write_robot(tmp_path / "other.yaml", 1.0, 0.04))
    with pytest.raises(ConfigError, match=r"the robot left the room after \d+\.\d s"):
        check_drive(replace(run, true_pose=run.true_pose + [3.0, 0.0, 0.0]), excitation.room)


@pytest.mark.usefixtures("quick")
def test_command_writes_drive_and_log(tmp_path):
    drive, log = tmp_path / "drive.yaml", tmp_path / "drive.csv"
    arguments = ["excite", "sm", "--for", "model", "--inside", "4x3", "--seconds", "15", "--plant", "model:sm"]
    result = invoke(app, *arguments, "--log", log, "--out", drive)
    assert "fence: {enabled: true, length: 4, width: 3, frame: start}" in result.output
    read_log(log).require_sound()
