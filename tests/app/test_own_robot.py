"""A user's robot: its configuration sets limits, tracks and sample times of all commands."""

from dataclasses import replace

import pytest
import yaml
from log_parts import MAPPING, bag_topics, drive, write_bag, write_csv, write_mapping

from commands import invoke
from diffdrive_mpc import ConfigError, identify, load_config
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.app.identification import trial_drives
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import load_reference, other_robots, start_pose
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from diffdrive_mpc.sim.plants.surface import load_surface

FAST = (
    "model: sm\nlimits: {v: 4.1, omega: 2.0, v_slew: 2.0, omega_slew: 6.0, predicted_v: 4.5, wheel_speed: 5.0}\n"
    "estimator: {max_wheel_speed: 8.0}\n"
)
PATHS = {
    "straight.yaml": "segments: [{v: 3.0, omega: 0.0, duration: 3.0}]\n",
    "bend.yaml": "waypoints: [[0, 0], [6, 0], [12, 2]]\nspeed: 3.0\nmax_deviation: 1.0\n",
}


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in {"fast.yaml": FAST, **PATHS}.items():
        (tmp_path / name).write_text(text)
    return tmp_path


def run(*arguments, code=0):
    result = invoke(app, *arguments, code=code)
    return " ".join((result.stdout if code == 0 else result.stderr).split())


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("controller", ["mpc", "kanayama"])
def test_trajectory_uses_the_limits_of_the_configuration(files, path, controller):
    case = Case(controller=controller, model="sm", trajectory=path, config="fast.yaml")
    reference = load_reference(case)
    assert reference.duration < 8.0
    assert max(reference.sample([0.5 * reference.duration]).twist[0]) == pytest.approx(3.0, rel=0.01)
    slow = Case(controller=controller, model="sm", trajectory=path, config="fast.yaml", overrides=(("limits.v", 2.0),))
    with pytest.raises(ConfigError, match="3 m/s is beyond the limit of 2 m/s"):
        load_reference(slow)
    assert start_pose(slow).tolist() == reference.sample([0.0]).pose[0].tolist()


def test_commands_drive_a_fast_path_with_its_configuration(files):
    arguments = ["--config", "fast.yaml", "--trajectory", "straight.yaml"]
    assert "completed: SM along" in run("simulate", *arguments, "--plant", "model:sm")
    bench = ["bench", "--config", "fast.yaml", "--models", "sm", "--plant", "model:sm", "--seeds", "1"]
    run(*bench, "--trajectories", "straight.yaml", "--horizons", "none", "--jobs", "1", "--out", "out")
    message = run("simulate", "--trajectory", "straight.yaml", code=2)
    assert "beyond the limit of 1.5 m/s; lower it, or state the configuration of the robot (--config)" in message
    assert "or --scale-to-robot" in run("simulate", "--trajectory", "s", "--set", "limits.v=0.3", code=2)


MAPPING_WITH_TRACK = MAPPING + "wheels: {track: 0.6, ticks_per_turn: 4096}\n"


@pytest.fixture(scope="module")
def identification(tmp_path_factory):
    """Folder and output for a log at 20 Hz with clock drift, of a robot whose wheels read 1.6 times its yaw rate."""
    folder = tmp_path_factory.mktemp("own")
    columns = drive(seconds=40.0, dt=0.05)
    columns["t"] = 1.000002 * columns["t"]
    log, mapping = write_csv(folder / "drive.csv", columns), write_mapping(folder / "map.yaml", MAPPING_WITH_TRACK)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(trial_drives, "PATHS", ("circle",))
        return folder, invoke(app, "identify", log.name, "--mapping", mapping.name, "--out", "my robot").stdout


def test_identify_writes_sample_time_track_and_surface_of_the_log(identification):
    folder, output = identification
    config = load_config(folder / "my robot" / "config.yaml")
    assert config.sample_time == 0.05
    assert config.wheels.encoder_track == 0.6
    assert config.wheels.track == pytest.approx(1.6 * 0.6, rel=0.05)
    assert config.limits.wheel_speed > config.limits.v
    assert load_surface(folder / "my robot" / "surface.yaml").slip.wheel_yaw_gain == pytest.approx(1 / 1.6, rel=0.02)
    assert "map.yaml: wheels.ticks_per_turn is not used: no column has the unit ticks" in output


def test_topics_and_types_of_a_bag_are_written_to_the_node_parameters(tmp_path):
    topics = {name.replace("/", "/base/"): rows for name, rows in bag_topics(drive()).items()}
    bag = write_bag(tmp_path / "bag", topics)
    names = "command: /base/cmd_vel, odometry: /base/odom, imu: /base/imu, pose: /base/pose"
    mapping = write_mapping(tmp_path / "map.yaml", f"topics: {{{names}}}\n")
    identify(bag, mapping=mapping).write(tmp_path / "out")
    text = (tmp_path / "out" / "node.yaml").read_text()
    assert "-r cmd_vel:=/base/cmd_vel -r odom:=/base/odom -r imu:=/base/imu\n" in text
    assert "# /base/pose carries geometry_msgs/msg/PoseStamped, which the node cannot read as pose" in text
    parameters = yaml.safe_load(text)["/**"]["ros__parameters"]
    assert parameters == {"stamped": False, "use_imu": True, "pose_source": "odometry"}
    assert NodeSettings(**parameters)


def test_plant_of_another_robot_than_the_configuration_is_reported(files):
    wide = load_config("sm", {"wheels.encoder_track": 0.6}).model_dump(mode="json")
    (files / "wide.yaml").write_text(yaml.safe_dump(wide))
    wide_robot, fast_robot = Case(model="sm", config="wide.yaml"), Case(model="sm", config="fast.yaml")
    (sentence,) = other_robots([wide_robot, wide_robot])
    assert "'mujoco' does not match the robot of the configuration" in sentence
    assert "its track is 0.33 m, the configuration's 0.6 m" in sentence
    (sentence,) = other_robots([fast_robot])
    assert "it clips v at 1.5 m/s, limits.v is 4.1 m/s" in sentence
    assert other_robots([Case(model="sm"), replace(fast_robot, plant="model:sm"), Case(controller="kanayama")]) == []
