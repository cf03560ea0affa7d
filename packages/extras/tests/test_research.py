"""Research tools: the Gymnasium environment and tables of many drives, compared with single runs of `simulate`."""

import sys

import numpy as np
import pytest

from diffdrive_mpc import (
    ArgumentError,
    ConfigError,
    Controller,
    MissingPackageError,
    load_config,
    load_trajectory,
    make_plant,
)
from diffdrive_mpc.bench.drive import plant_settings
from diffdrive_mpc.bench.run_row import statistics_of
from diffdrive_mpc.sim import simulate
from diffdrive_mpc_extras.research.environment import make_env
from diffdrive_mpc_extras.research.many_drives import drive_many

TRACKING_ENV = "diffdrive_mpc_extras.research.tracking_env"


def drive(env, commands, seed=None):
    """Drive an episode; return observations (n + 1, ...), rewards (n,) and (terminated, truncated, info) of the end."""
    observation, _ = env.reset(seed=seed)
    observations, rewards = [observation], []
    for command in commands:
        observation, reward, *status = env.step(command)
        observations.append(observation)
        rewards.append(reward)
        if any(status[:2]):
            break
    return np.array(observations), np.array(rewards), status


@pytest.mark.filterwarnings("ignore")
def test_environment_passes_the_gymnasium_checker():
    pytest.importorskip("gymnasium")
    from gymnasium.utils.env_checker import check_env

    check_env(make_env(plant="model:ssm", preview=3))


@pytest.mark.parametrize("plant", ["mujoco", "model:sm"])
def test_metrics_of_an_episode_equal_those_of_the_bench(plant):
    seeding = pytest.importorskip("gymnasium.utils.seeding")
    config, reference = load_config("ssm"), load_trajectory("s")
    plant_seed = int(seeding.np_random(5)[0].integers(2**31))
    run = simulate(Controller(config), make_plant(plant, seed=plant_seed, **plant_settings(config)), reference)
    observations, rewards, (terminated, truncated, info) = drive(make_env("s", config, plant=plant), run.command, 5)
    assert (terminated, truncated, info["ended"]) == (False, True, "")
    assert info["metrics"] == pytest.approx(
        statistics_of(run, timed=False) | solver_columns(info["metrics"]), nan_ok=True
    )
    measured = np.array([m.yaw_rate.value if m.yaw_rate else np.nan for m in run.measurements])
    assert np.nanmax(np.abs(observations[: len(measured), 4] - measured)) == 0.0
    assert -rewards[:-1].min() == pytest.approx(run.metrics.position_max_m, rel=1e-9)


def solver_columns(metrics):
    """Return the metrics of a solver, which do not exist for an agent."""
    names = ("iterations", "method_", "path_", "not_solved")
    return {name: value for name, value in metrics.items() if name.startswith(names)}


def test_same_seed_repeats_an_episode_and_an_episode_without_seed_differs():
    pytest.importorskip("gymnasium")
    env, commands = make_env(plant="model:ssm"), np.tile([0.3, 0.3], (40, 1))
    first, repeated, unseeded = (drive(env, commands, seed)[0] for seed in (1, 1, None))
    assert np.array_equal(first, repeated) and not np.array_equal(first, unseeded)


def test_episode_terminates_beyond_the_maximum_error():
    pytest.importorskip("gymnasium")
    env = make_env(plant="model:ssm", max_error=0.2)
    _, rewards, (terminated, truncated, info) = drive(env, np.zeros((700, 2)))
    assert terminated and not truncated and 0.2 < -rewards[-1] < 0.22
    assert "max_error is 0.2 m" in info["ended"]
    with pytest.raises(RuntimeError, match="call reset"):
        env.step([0.0, 0.0])


def test_invalid_arguments_and_commands_raise_errors():
    pytest.importorskip("gymnasium")
    for preview in (-1, 1.5):
        with pytest.raises(ValueError, match=f"^make_env: preview = {preview}: give 0 to 200 ticks$"):
            make_env(preview=preview)
    with pytest.raises(ValueError, match="^make_env: max_error = 0.0: give more than 0 m$"):
        make_env(max_error=0.0)
    env = make_env(plant="model:ssm")
    with pytest.raises(RuntimeError, match="call reset"):
        env.step([0.0, 0.0])
    env.reset()
    for action in ([np.nan, 0.0], [0.1], "x"):
        with pytest.raises(ValueError, match="give two finite numbers"):
            env.step(action)


def test_missing_gymnasium_raises_missing_package_error_with_the_install_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, TRACKING_ENV, raising=False)
    with pytest.raises(
        MissingPackageError, match=r"^make_env needs gymnasium: pip install 'diffdrive-mpc-extras\[gym\]'$"
    ):
        make_env()


@pytest.mark.parametrize("jobs", [1, 2])
def test_rows_of_many_drives_equal_single_runs(jobs):
    short = load_config("ssm", {"horizon": 10})
    table = drive_many(
        {"long": "ssm", "short": short}, ["s", load_trajectory("cane")], (3, 4), plant="model:sm", jobs=jobs
    )
    assert len(table) == 8 and (table["ended"] == "").all()
    assert table[["config", "trajectory", "seed"]].drop_duplicates().shape == (8, 3)
    run = simulate(
        Controller(short), make_plant("model:sm", seed=4, **plant_settings(short)), load_trajectory("s", short)
    )
    (row,) = table.query("config == 'short' and trajectory == 's' and seed == 4").to_dict("records")
    expected = statistics_of(run, timed=False)
    assert {name: row[name] for name in expected} == pytest.approx(expected, nan_ok=True)


def test_invalid_arguments_of_many_drives_raise_config_error_before_the_first_drive():
    finished_drives = []
    for change in ({"configs": ["ssm", "smm"]}, {"trajectories": "cirle"}, {"plant": "mujco"}, {"trajectories": []}):
        with pytest.raises(ConfigError, match="unknown|did you mean|has no value"):
            drive_many(**{"seeds": [0], "on_done": lambda: finished_drives.append(1), **change})
    assert not finished_drives
    for seeds in ([], [0.5], [0, 0]):
        with pytest.raises((ArgumentError, ConfigError), match="seeds: (expected at least one|'0' is given twice)"):
            drive_many("ssm", "circle", seeds, plant="model:ssm")
    with pytest.raises(ArgumentError, match=r"configuration: .*got Controller; give .* controller.config"):
        drive_many(Controller("ssm"))
