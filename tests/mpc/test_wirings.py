"""Sensors with wrong wiring: messages name the sensor and its fault on random robots that were not used for tuning."""

import re
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import yaml

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.experiment import run_case
from diffdrive_mpc.bench.runner import run_tasks

WIRINGS = yaml.safe_load(Path(__file__).with_name("wirings.yaml").read_text(encoding="utf-8"))
PATHS = ("circle", "s", "square", "cane", "figure8")
RESERVED = 9100
"""First seed of the random robots that were not used to choose thresholds."""
KINDS = {
    "reversed": r"(times as far as poses: set sensors.yaw_rate.sign: -1|swap the sides, or correct the signs)",
    "scaled": r"(set sensors.yaw_rate.scale|it measures no turn|its readings repeat|correct ticks and radius)",
    "turned": r"set sensors.pose.heading: -?\d",
    "mirrored": "",
}


def named_sensors(message):
    """Return the sensors that a message reports as unused or late."""
    sensors = set(re.findall(r"(wheel speed|yaw rate|pose) not used", message))
    return sensors | ({"late"} if "later than their stamps" in message else set())


def drive(wiring, robot, folder):
    """Return the messages of a drive about sensors, and the maximum lateral error before the first message [m]."""
    file, path = Path(folder, f"{wiring}.yaml"), PATHS[robot % len(PATHS)]
    run = run_case(Case(model="sm", trajectory=path, plant=f"drawn:{robot}", seed=robot, sensors=str(file)))
    pairs = [(time, message) for time, message in zip(run.time, run.messages, strict=True) if named_sensors(message)]
    end = pairs[0][0] if pairs else np.inf
    return [message for _, message in pairs], float(np.abs(np.asarray(run.errors.lateral)[run.time <= end]).max())


def is_right(wiring, messages):
    """Return True if messages name no sensor except the faulty sensor, and one message names its fault."""
    ((sensor, kind),) = WIRINGS[wiring]["answer"].items()
    expected = "late" if kind == "late" else sensor
    # A reversed or scaled gyro may be reported as late before the robot has turned far enough.
    others = set().union(*map(named_sensors, messages)) - {expected, "late"} if messages else {"none"}
    return not others and any(
        expected in named_sensors(text) and re.search(KINDS.get(kind, ""), text) for text in messages
    )


def write_sensor_sets(folder):
    for wiring, spec in WIRINGS.items():
        Path(folder, f"{wiring}.yaml").write_text(yaml.safe_dump(spec["sensors"]), encoding="utf-8")


def judge_wirings(robots, folder, jobs=1):
    """Return (wiring, robot) pairs with wrong messages, lateral errors before the messages [m], and the case count."""
    write_sensor_sets(folder)
    cases = [(wiring, robot) for wiring in WIRINGS for robot in robots]
    drives = run_tasks([partial(drive, *case, folder) for case in cases], jobs, lambda *_: None)
    wrong_cases = [case for case, (messages, _) in zip(cases, drives, strict=True) if not is_right(case[0], messages)]
    return wrong_cases, np.array([lateral for _, lateral in drives]), len(cases)


def follows(robot):
    """Return True if a robot with correct wiring follows its path."""
    case = Case(model="sm", trajectory=PATHS[robot % len(PATHS)], plant=f"drawn:{robot}", seed=robot)
    metrics = run_case(case).metrics
    return metrics.completed and metrics.position_rmse_m < 0.1


def robots_that_follow(count=20):
    """Return the first robots that follow their path with correct wiring; other robots slide or stop."""
    return list(islice(filter(follows, range(RESERVED + 300, RESERVED + 350)), count))


@pytest.mark.system
@pytest.mark.parametrize("robot_count", [2, pytest.param(20, marks=pytest.mark.long)])
def test_messages_name_wrong_wirings_on_random_robots(robot_count, tmp_path):
    robots = robots_that_follow(robot_count)
    wrong_cases, lateral, count = judge_wirings(robots, tmp_path, jobs=2)
    assert len(wrong_cases) <= 0.03 * count, wrong_cases
    assert np.median(lateral) < 0.1


def named_settings(messages):
    """Return pairs of key and value from the last message with settings."""
    settings = [re.findall(r"(sensors\.\w+\.(?:\w+_)?(?:sign|scale|heading)): (-?[\d.]+)", text) for text in messages]
    last = next((pairs for pairs in reversed(settings) if pairs), [])
    return tuple((key, int(value) if key.endswith("sign") else float(value)) for key, value in last)


def lateral_square(robot, **options):
    """Return the mean square lateral error after 3 s, over three seeds [m^2]."""
    path, seeds = PATHS[robot % len(PATHS)], (robot, robot + 1000, robot + 2000)
    cases = [Case(model="sm", trajectory=path, plant=f"drawn:{robot}", seed=seed, **options) for seed in seeds]
    runs = [run_case(case) for case in cases]
    return np.mean([np.mean(np.asarray(run.errors.lateral)[run.time > 3.0] ** 2) for run in runs])


def lateral_square_with_remedy(wiring, robot, folder):
    """Return the mean square lateral error with the settings from messages, or None without such messages."""
    settings = named_settings(drive(wiring, robot, folder)[0])
    options = {"sensors": str(Path(folder, f"{wiring}.yaml")), "overrides": settings}
    return lateral_square(robot, **options) if settings else None


@pytest.mark.long
def test_setting_from_a_message_restores_tracking(tmp_path):
    """Errors of robots with correctable wirings are compared with errors of the same robots with correct wiring."""
    robots = robots_that_follow()
    wirings = [
        name for name, wiring in WIRINGS.items() if set(wiring["answer"].values()) & {"reversed", "scaled", "turned"}
    ]
    write_sensor_sets(tmp_path)
    cases = [(name, robot) for name in wirings for robot in robots]
    tasks = [partial(lateral_square, robot) for robot in robots]
    tasks += [partial(lateral_square_with_remedy, *case, tmp_path) for case in cases]
    squares = run_tasks(tasks, 2, lambda *_: None)
    correct = dict(zip(robots, squares, strict=False))
    pairs = zip(cases, squares[len(robots) :], strict=True)
    ratios = [np.sqrt(square / correct[robot]) for (_, robot), square in pairs if square is not None]
    assert np.mean(np.array(ratios) <= 1.5) >= 0.95, np.round(np.sort(ratios), 2)[-20:]
