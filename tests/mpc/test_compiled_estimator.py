"""The estimator in C gives the numbers and the sentences of the Python one, whatever arrives."""

import numpy as np
import pytest
from diffdrive_mpc.mpc.compiled.compiler import NotCompiledError
from diffdrive_mpc.mpc.compiled.estimator import CompiledEstimator
from diffdrive_mpc.mpc.compiled.library import checked_constants, load_library
from diffdrive_mpc.mpc.estimator import StateEstimator
from hypothesis import example, given, settings
from hypothesis import strategies as st
from ideal_robot import IdealRobot

from diffdrive_mpc.models import Measurement, Stamped, load_model
from diffdrive_mpc.mpc.config.schema import Compensation, Estimator
from diffdrive_mpc.mpc.estimation.slip import Slip

DT = 0.0202
SAMPLED = {name: load_model(name).with_extra_dead_time([0.01, 0.03]).discretise(DT) for name in ("ssm", "sm", "mbm")}
SLIP = Slip(v_offset=0.03, longitudinal_gain=0.99, yaw_gain=0.7, side_slip=0.06)


class Twins:
    """Both estimators on the same robot; `tick` compares everything that they say."""

    def __init__(self, name="ssm", noise=1.0, **settings):
        self.model = SAMPLED[name]
        self.settings = Estimator(**settings)
        self.parts = [kind(self.model, self.settings) for kind in (StateEstimator, CompiledEstimator)]
        self.robot = IdealRobot(self.model, np.array([1.0, 2.0, 3.0]), slip=SLIP, noise=noise, seed=3)
        self.queue = []
        self.told = []

    def tick(self, change=lambda m, twins: m, skip=False, sent=False):
        robot, k = self.robot, self.robot.k
        measurement = robot.measure()
        self.queue.append(measurement.pose)
        command = np.array([0.5 + 0.2 * np.sin(k / 15), 0.8 * np.sin(k / 25)])
        if not skip:
            measurement = change(measurement, self)
            for part in self.parts:
                if sent:
                    assert part.correct_sent((float(command[0]), 0.9 * float(command[1]))) == []
                part.advance(robot.time)
            told, same = (part.update(robot.time, measurement) for part in self.parts)
            assert told == same
            self.told += told
            if self.parts[0].moved and k % 7 == 0:
                assert [part.restart_elsewhere() for part in self.parts] == [True, True]
            self.compare()
            for part in self.parts:
                part.commands.append(command)
        robot.advance(command)

    def compare(self):
        python, compiled = self.parts
        assert (python.ready, python.moved) == (compiled.ready, compiled.moved)
        if python.ready:
            expected = python.estimate
            assert compiled.estimate.values == pytest.approx(expected.values, abs=1e-9, rel=1e-9, nan_ok=True)
            assert compiled.estimate.slip.yaw_gain == pytest.approx(expected.slip.yaw_gain, abs=1e-9)
            assert compiled.estimate.innovations.keys() == expected.innovations.keys()


def late(ticks):
    return lambda m, twins: Measurement(twins.queue[-1 - min(ticks, len(twins.queue) - 1)], m.wheel_twist, m.yaw_rate)


def pose(change, **stated):
    def changed(m, twins):
        value, time = change(m.pose.value, m.pose.time)
        return Measurement(Stamped(value, time, **stated), m.wheel_twist, m.yaw_rate)

    return changed


def wheels(value, **stated):
    return lambda m, twins: Measurement(m.pose, Stamped(value, m.wheel_twist.time, **stated), m.yaw_rate)


SPOILERS = {
    "nothing": lambda m, twins: Measurement(),
    "in time": lambda m, twins: m,
    "pose only": lambda m, twins: Measurement(m.pose),
    "one tick late": late(1),
    "five ticks late": late(5),
    "between ticks": pose(lambda p, t: (p, t - 0.37 * DT)),
    "in the future": pose(lambda p, t: (p, t + 0.3)),
    "too old": pose(lambda p, t: (p, t - 3.0)),
    "not finite": pose(lambda p, t: ([np.nan, 0.0, 0.0], t)),
    "not numbers": pose(lambda p, t: ("here", t)),
    "a list": pose(lambda p, t: (p.tolist(), t)),
    "no stamp": pose(lambda p, t: (p, None)),
    "false pose": pose(lambda p, t: (p + [3.0, 0.0, 0.0], t)),
    "pushed": pose(lambda p, t: (p + [0.2, 0.1, 0.3], t)),
    "turned once more": pose(lambda p, t: (p + [0.0, 0.0, 2 * np.pi], t)),
    "covariance": pose(lambda p, t: (p, t), covariance=np.diag([1e-4, 2e-4, 3e-4]) + 1e-5),
    "bad covariance": pose(lambda p, t: (p, t), covariance=np.diag([1e-4, -2e-4, 3e-4])),
    "singular covariance": pose(lambda p, t: (p, t), covariance=np.ones((3, 3))),
    "uneven covariance": pose(lambda p, t: (p, t), covariance=[[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]),
    "wheels stopped": wheels([0.0, 0.0]),
    "wheels too fast": wheels([0.1, 40.0]),
    "wheels broken": wheels([np.inf, 0.0]),
    "wheels with covariance": wheels([0.5, 0.1], covariance=np.diag([1e-3, 1e-2])),
    "wheels with a bad one": wheels([0.5, 0.1], covariance=[[1e-3, 1.0], [1.0, 1e-3]]),
    "gyro only": lambda m, twins: Measurement(yaw_rate=m.yaw_rate),
    "gyro jumps": lambda m, twins: Measurement(m.pose, yaw_rate=Stamped(6.0, m.yaw_rate.time)),
    "gyro as a number of its own": lambda m, twins: Measurement(
        m.pose, yaw_rate=Stamped([0.5], m.yaw_rate.time, [[1e-4]])
    ),
}


@pytest.mark.parametrize("name", SAMPLED)
def test_a_long_drive_with_late_poses(name):
    twins = Twins(name)
    for k in range(250):
        twins.tick(late(2 if k % 3 else 1), skip=k % 97 == 60, sent=k % 5 == 0 and k > 0)
    assert twins.parts[1].estimate.slip.yaw_gain == pytest.approx(SLIP.yaw_gain, abs=0.1)


@pytest.mark.parametrize("spoiler", SPOILERS)
def test_one_fault_in_the_middle_of_a_drive(spoiler):
    twins = Twins(noise=0.5)
    for k in range(90):
        twins.tick(SPOILERS[spoiler] if 40 <= k < 44 else SPOILERS["in time"])


FAULTS = st.lists(st.tuples(st.sampled_from(sorted(SPOILERS)), st.integers(0, 9)), min_size=60, max_size=60)


@settings(max_examples=10)
@example([("false pose", 5)] * 60, "ssm")
@example([("pushed", 5)] * 60, "mbm")
@given(FAULTS, st.sampled_from(sorted(SAMPLED)))
def test_whatever_arrives(events, name):
    twins = Twins(name)
    for spoiler, choice in events:
        twins.tick(SPOILERS[spoiler], skip=choice == 0, sent=choice == 1)


def test_more_than_is_kept_for_one_sample_is_rejected_and_named():
    twins = Twins()
    for _ in range(30):
        twins.tick()
    now = twins.robot.time - DT
    for part in range(1, 14):
        twist = Stamped([0.5, 0.1], now + 1e-4 * part)
        measured = Measurement(
            Stamped(twins.queue[-1].value, now + 1e-4 * part), twist, Stamped(0.3, now + 1e-4 * part)
        )
        told, same = (part.update(now + 0.01, measured) for part in twins.parts)
        assert told == same
        twins.told += told
        twins.compare()
    assert {told for told in twins.told if "more arrived" in told} == {
        f"{name} rejected: more arrived for one sample than is kept" for name in ("pose", "wheel speed", "yaw rate")
    }


def test_what_is_not_compensated_stays_as_without_slip():
    model = SAMPLED["sm"]
    compensation = Compensation(v_offset=False, yaw_gain=False, side_slip=False)
    parts = [kind(model, Estimator(), compensation) for kind in (StateEstimator, CompiledEstimator)]
    robot = IdealRobot(model, np.zeros(3), slip=SLIP)
    for _ in range(50):
        measurement = robot.measure()
        for part in parts:
            part.advance(robot.time)
            part.update(robot.time, measurement)
            part.commands.append(np.array([0.4, 0.5]))
        robot.advance(np.array([0.4, 0.5]))
    assert parts[1].estimate.slip == Slip()
    assert parts[1].estimate.values == pytest.approx(parts[0].estimate.values, abs=1e-9)


def test_forgetting_leaves_the_commands():
    twins = Twins()
    for _ in range(40):
        twins.tick()
    for part in twins.parts:
        part.forget()
        assert not part.ready
    for _ in range(10):
        twins.tick()
    assert np.abs(twins.parts[1].estimate.twist).max() > 0.1


def test_constants_that_do_not_fill_the_struct_are_refused():
    library = load_library(
        ("estimator.c", "filter.c", "checks.c"),
        {"DDMPC_STATES": 2} | {"DDMPC_DELAY_V": 0, "DDMPC_DELAY_OMEGA": 0, "DDMPC_HISTORY": 5},
    )
    with pytest.raises(ValueError, match="ddmpc_estimation_size"):
        checked_constants(library, "ddmpc_estimation_size", np.zeros(7))


def test_c_that_does_not_compile_says_so():
    with pytest.raises(NotCompiledError, match="failed"):
        load_library(("estimator.c",), {"DDMPC_STATES": 2})
