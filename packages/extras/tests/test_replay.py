"""`log replay`: replay of drives of `simulate` and of the node, and the printed differences of commands."""

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from rclpy.parameter import Parameter
from ros_parts import stack
from two_processes import drive_over_dds

from commands import call
from diffdrive_mpc import ConfigError, ControllerConfig, load_config, load_trajectory
from diffdrive_mpc.app.run_log import run_log
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build
from diffdrive_mpc.models.load import model_path
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.log_mcap import write_log
from diffdrive_mpc_extras.replay.logged_config import config_from_log
from diffdrive_mpc_extras.replay.node_log import LoggedConfigs
from diffdrive_mpc_extras.replay.own_log import read_recording
from diffdrive_mpc_extras.replay.replay import replay

DT = 0.0202
EQUAL_MESSAGE = "recorded and replayed commands are equal at every tick"

# Cases for all kinds of models, and for all causes of other modes or solver paths.
CASES = {
    "circle": Case(),
    "sm": Case(model="sm", trajectory="square"),
    "mbm": Case(model="mbm", trajectory="cane"),
    "network": Case(model="lstm", trajectory="k_turn", overrides=(("horizon", 10),)),
    "drive": Case(model="p2_physical", trajectory="k_turn"),
    "tight, on its limits": Case(trajectory="tight", overrides=(("limits.v_slew", 0.6), ("limits.wheel_speed", 0.5))),
    "fast": Case(trajectory="fast_circle"),
    "pushed": Case(scenario="push"),
    "poses lost": Case(scenario="sensor_dropouts"),
    "poses jump": Case(scenario="pose_jump"),
    "poses drift": Case(scenario="drifting_pose"),
    "blocked": Case(scenario="blocked"),
    "late poses": Case(sensors="slam"),
    "rare poses": Case(sensors="poses_2hz"),
    "late commands": Case(late=3),
    "start after a rest": Case(overrides=(("start_delay", 0.2),)),
}


def run_and_log(case, folder):
    """Run a case; return the run, its log and the configuration."""
    controller, plant, reference = build(case)
    run = simulate(controller, plant, reference)
    path = Path(folder) / "drive.mcap"
    with run_log(path) as write:
        write(run, case)
    return run, path, controller.config


def read_log(path):
    return read_recording(path, LoggedConfigs(path, path.parent))


def log_replay(*arguments, code=0):
    """Run `log replay`; return its output with single spaces."""
    return " ".join(call("log", "replay", *arguments, code=code).split())


@pytest.mark.parametrize("name", CASES)
def test_log_replays_to_the_same_commands(name, tmp_path):
    run, path, config = run_and_log(CASES[name], tmp_path)
    recording = read_log(path)
    replayed = replay(recording, config, recording.references, as_recorded=False)
    assert np.array_equal(recording.command, run.command)
    assert np.abs(replayed.command - run.command).max() < 1e-9
    assert replayed.modes == run.modes and not recording.notes
    # With the original trajectory the commands are equal to the last bit.
    exact = replay(recording, config, (load_trajectory(CASES[name].trajectory, config),), as_recorded=False)
    assert np.array_equal(exact.command, run.command)
    assert exact.messages == run.messages


def test_slew_limit_of_another_configuration_applies_to_the_recorded_command(tmp_path):
    _, path, _ = run_and_log(Case(), tmp_path)
    recording = read_log(path)
    config = load_config("ssm", {"weights.across": 400.0, "limits.v_slew": 0.9})
    replayed = replay(recording, config, recording.references, as_recorded=False)
    assert np.abs(replayed.command - recording.command).max() > 0.01
    change = np.abs(replayed.command[1:] - recording.command[:-1])
    assert (change[:, 1] <= config.limits.omega_slew * DT + 1e-9).all()


def test_unshipped_trajectory_is_interpolated_with_a_note_and_exact_with_its_file(tmp_path):
    path = tmp_path / "path.yaml"
    path.write_text("segments:\n- {v: 0.4, omega: 0.3, duration: 3.0}\n- {v: 0.3, omega: -0.4, duration: 3.0}\n")
    run, log, config = run_and_log(Case(trajectory=str(path), plant="model:ssm"), tmp_path)
    recording = read_log(log)
    replayed = replay(recording, config, recording.references, as_recorded=False)
    assert np.abs(replayed.command - run.command).max() < 1e-9
    assert "--trajectory with its file makes the replay exact" in recording.notes[0]
    assert EQUAL_MESSAGE in log_replay(log, "--trajectory", path)


@pytest.fixture(scope="module")
def mcap(tmp_path_factory):
    """Return the log of a drive of a drawn robot with deleted model and configuration files."""
    folder = tmp_path_factory.mktemp("mcap")
    model, config, log = folder / "model.yaml", folder / "config.yaml", folder / "drive.mcap"
    model.write_text(model_path("sm").read_text())
    config.write_text("model: model.yaml\nhorizon: 20\nweights: {across: 90.0}\n")
    call("simulate", "--config", config, "--trajectory", "cane", "--plant", "drawn:5", "--log", log)
    model.unlink()
    config.unlink()
    return log


def test_mcap_log_replays_with_the_configuration_that_it_contains(mcap):
    output = log_replay(mcap)
    assert EQUAL_MESSAGE in output and "v [m/s] 0 0" in output and "omega [rad/s] 0 0" in output


def test_changed_setting_is_compared_with_the_recorded_commands(mcap):
    output = log_replay(mcap, "--set", "weights.across=500")
    assert "recorded and replayed commands differ" in output
    row = output.split("v [m/s] ")[1].split()
    # RMS, maximum difference, its time, ticks that differ, time of the first one.
    assert 0.0 < float(row[0]) < float(row[1]) < 1.0 and int(row[3]) > 0 and float(row[4]) <= float(row[2])


@pytest.fixture
def log(tmp_path):
    _, path, _ = run_and_log(Case(plant="model:ssm", trajectory="circle"), tmp_path)
    return path


def truncate(content):
    return content[: len(content) // 2]


INVALID_LOGS = {
    "truncated": (truncate, 0, "the end of the file is missing"),
    "empty": (lambda content: b"", 2, "only these can be replayed"),
    "a CSV log": (lambda content: b"t_s,v_ref_m_s\n0,0\n", 2, "only these can be replayed"),
}


@pytest.mark.parametrize("name", INVALID_LOGS)
def test_invalid_log_is_read_partly_or_refused_in_one_line(name, log):
    change, code, message = INVALID_LOGS[name]
    log.write_bytes(change(log.read_bytes()))
    assert message in log_replay(log, "--model", "ssm", code=code)


def test_log_of_a_few_ticks_is_refused(tmp_path):
    path = tmp_path / "short.yaml"
    path.write_text("segments: [{v: 0.1, omega: 0.0, duration: 0.02}]\ntiming: commanded\n")
    _, log, _ = run_and_log(Case(trajectory=str(path), plant="model:ssm"), tmp_path)
    assert "at least 10 are needed; record for longer" in log_replay(log, code=2)


def test_wrong_sample_time_is_refused_in_one_line(log):
    output = log_replay(log, "--model", "ssm", "--set", "sample_time=0.1", code=2)
    assert "the period of its ticks is 20.2 ms, sample_time is 100 ms" in output and "Traceback" not in output


def test_log_without_a_configuration_is_refused_in_one_line(tmp_path):
    controller, plant, reference = build(Case(plant="model:ssm"))
    write_log(simulate(controller, plant, reference), tmp_path / "drive.mcap")
    output = log_replay(tmp_path / "drive.mcap", code=2)
    assert "the log does not contain a configuration; use --config or --model" in output


CASE = Case(trajectory="cane", sensors="slam", overrides=(("weights.across", 90.0),))


@pytest.mark.system
@pytest.mark.parametrize("lock_step", [True, False])
def test_mcap_bag_of_the_node_replays_to_the_last_bit(lock_step, tmp_path):
    _, _, reference = build(CASE)
    for attempt in range(3):
        folder = tmp_path / str(attempt)
        drive_over_dds(CASE, reference.duration, folder, lock_step=lock_step, timeout=120.0)
        (bag,) = folder.glob("*.mcap")
        # In real time the node may start late, or before the discovery of the recorded topics.
        with suppress(ConfigError):
            recording = read_recording(bag, LoggedConfigs(bag, tmp_path))
            if not recording.notes and len(recording.ticks) > 300:
                break
    assert recording.config.weights.across == 90.0 and not recording.notes
    assert len(recording.ticks) > 300
    replayed = replay(recording, recording.config, recording.references, as_recorded=True)
    assert np.array_equal(replayed.command, recording.command)
    assert replayed.modes == tuple(tick.mode for tick in recording.ticks)
    assert "commands are equal at every tick" in log_replay(bag)


def test_replay_of_an_eventful_drive_reproduces_its_commands(tmp_path):
    """The drive has pauses, changed limits, missing odometry, and a reset with a second start."""
    folder = tmp_path / "drives"
    with stack(drive=True, record=True, record_folder=str(folder), trajectory="k_turn", start_at_robot=True) as s:
        s.base.run(40)
        s.loop.pause()
        s.base.run(30)
        s.loop.start()
        s.base.run(30)
        s.node.set_parameters([Parameter("limits.v_slew", value=0.6), Parameter("weights.across", value=90.0)])
        s.base.run(30)
        tamper, s.base.tamper = s.base.tamper, lambda odometry: None
        s.base.run(20)
        s.base.tamper = tamper
        s.base.run(30)
        s.loop.pause()
        s.base.run(60)
        s.loop.reset()
        s.base.run(5)
        s.loop.start()
        s.base.run(60)
    (path,) = folder.iterdir()
    recording = read_recording(path, LoggedConfigs(path, tmp_path))
    assert not recording.notes
    assert {"TRACKING", "BRAKING", "STOPPED"} <= {tick.mode for tick in recording.ticks}
    assert len([tick for tick in recording.ticks if tick.start is not None]) == 2
    assert any(tick.hold is not None for tick in recording.ticks) and any(tick.config for tick in recording.ticks)
    replayed = replay(recording, recording.config, recording.references, as_recorded=True)
    # A transformed path is sampled in Python and in C, with different rounding.
    assert np.abs(replayed.command - recording.command).max() < 1e-12
    assert replayed.messages == tuple(tick.message for tick in recording.ticks)


def test_configuration_is_read_if_it_does_not_enable_a_removed_group():
    values = ControllerConfig().model_dump(mode="json")
    unused = values | {"online_dead_time": {"enabled": False, "apply": True}}
    assert config_from_log(unused, "drive.mcap") == config_from_log(values, "drive.mcap")
    with pytest.raises(ConfigError, match=r"online_dead_time\.enabled was removed"):
        config_from_log(values | {"online_dead_time": {"enabled": True}}, "drive.mcap")
