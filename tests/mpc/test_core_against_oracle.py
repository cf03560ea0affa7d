"""The product's controller against the oracle: equal measurements give equal commands, estimates, modes and messages.

Results agree to 1e-9, except solves of OSQP and DAQP with active limits, which agree to a stated accuracy.
"""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from failing_solver import CorruptedReference
from hypothesis import example, given, settings
from hypothesis import strategies as st
from ideal_robot import IdealRobot
from side_by_side import ACTIVE_SET, Pair, replace_parts

from diffdrive_mpc import Measurement, Stamped, load_config, load_model, load_trajectory, make_plant
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.problem.slip import Slip
from diffdrive_mpc.mpc.solver.report import SolverStatus
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.moved import starting_at
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_commands

DT = 0.0202
HARD = {"limits.v": 0.5, "limits.omega": 1.05, "limits.v_slew": 0.5, "limits.omega_slew": 1.5}
TWO_SIDED = {
    "limits.v": {"forward": 0.5, "reverse": 0.2},
    "limits.omega": {"left": 1.05, "right": 0.8},
    "limits.v_slew": {"accelerate": 0.8, "brake": 0.4},
    "limits.omega_slew": {"accelerate": 1.2, "brake": 3.0},
}
SOFT = {"limits.predicted_v": 0.45, "limits.predicted_omega": 0.5, "limits.wheel_speed": 0.55, "limits.corridor": 0.01}
PRECISE = {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 100_000}
# The tolerance of OSQP applies to its residuals, not to the commands.
OSQP = {"solver.method": "osqp"} | {f"solver.osqp.{key}": value for key, value in PRECISE.items()}
OSQP_ACCURACY = 1e-6
# DAQP drops rows with almost no effect of the commands, such as the corridor at the first steps.
DAQP_ACCURACY = 1e-4


def pair(name="ssm", accuracy=1e-9, **changes):
    return Pair(load_config(name, ACTIVE_SET | changes), accuracy=accuracy)


@pytest.mark.parametrize(
    ("name", "reference"), [("ssm", "circle"), ("ssm", "s"), ("sm", "square"), ("sm", "circle"), ("mbm", "cane")]
)
def test_drive_with_the_shipped_configuration_agrees(name, reference):
    """The mode of every tick is TRACKING."""
    both = Pair(load_config(name))
    both.drive(make_plant("mujoco", seed=0), load_trajectory(reference), 60)
    assert both.modes == ["TRACKING"]


@pytest.mark.parametrize(
    ("limits", "solver_settings", "accuracy"),
    [(HARD, ACTIVE_SET, 1e-9), (SOFT, ACTIVE_SET, 1e-9), (HARD | SOFT, OSQP, OSQP_ACCURACY)],
    ids=["hard, active set", "soft, active set", "both, osqp"],
)
def test_drive_along_its_limits_agrees(limits, solver_settings, accuracy):
    both = pair("sm", accuracy, **limits | solver_settings)
    ticks = 50 if solver_settings is OSQP else 90
    results = both.drive(make_plant("mujoco", seed=0), load_trajectory("square"), ticks)
    assert both.modes == ["TRACKING"]
    assert np.mean([r.solver.iterations > 0 for r in results]) > 0.8, "the limits must be active"
    assert any(r.solver.soft_limits for r in results) == (limits is not HARD)


# Events of a drive: each receives tick, time, measurement and the pair, and returns time, measurement and hold.


def displace(k, t, m, both):
    return t, shift_pose(m, [0.15, 0.13, 0.1]) if k >= 30 else m, None


def displace_far(k, t, m, both):
    return t, shift_pose(m, [0.0, 0.8, 0.3]) if k >= 30 else m, None


def false_pose(k, t, m, both):
    return t, shift_pose(m, [2.0, 0.0, 0.0]) if k in (30, 31, 60) or 80 <= k < 92 else m, None


def no_pose(k, t, m, both):
    return t, replace_parts(m, pose=None) if 30 <= k < 80 or k < 3 else m, None


def no_pose_for_long(k, t, m, both):
    if k == 180:
        both.resume()
    return t, replace_parts(m, pose=None) if 30 <= k < 175 else m, None


def first_pose_wrong(k, t, m, both):
    return t, shift_pose(m, [0.0, 0.8, 0.0]) if k == 0 else m, None


def no_measurement(k, t, m, both):
    return t, Measurement() if 30 <= k < 40 else m, None


class Late:
    """Event: poses are several ticks late and do not arrive in every tick."""

    def __init__(self):
        self.queue = []

    def __call__(self, k, t, m, both):
        self.queue.append(m.pose)
        age = (1, 4, 4, 9, 2)[k % 5]
        return t, replace_parts(m, pose=self.queue[max(0, k - age)]), None


def halved_commands(k, t, m, both):
    """Report applied commands that differ from the sent commands or are invalid."""
    if k < 2:
        return t, m, None
    v, omega = 0.5 * both.results[-1].command
    return t, replace_parts(m, sent=(7.0, 0.0) if k % 17 == 0 else (v, omega) if k % 3 else (4.9, -9.0)), None


def foreign_commands(k, t, m, both):
    """Apply commands of another controller; some exceed the limits, and the first sequence exceeds the memory."""
    if k == 0:
        both.override(np.tile([0.3, -0.2], (700, 1)))
    elif k % 3:
        both.override(np.array([[0.4 * math.sin(0.1 * k), 0.3], [0.9 if 30 <= k < 40 else 0.4, math.cos(0.07 * k)]]))
    return t, m, None


@pytest.mark.parametrize("solver", [{}, {"solver.method": "daqp"}])
def test_change_of_direction_with_two_sided_limits_agrees(solver):
    """The reference reverses direction and turn at once: commands pass through zero within a tick."""
    reference = time_commands(
        [Segment(v=0.3, omega=0.5, duration=0.8), Segment(v=-0.18, omega=-0.5, duration=1.2)],
        TrajectoryLimits.of_robot(),
        name="back and forth",
    )
    both = pair("ssm", 1e-6 if solver else 1e-9, **{"horizon": 15} | TWO_SIDED | solver)
    both.drive(make_plant("model:ssm", seed=4), reference, 90)
    assert both.modes == ["TRACKING"]


def hold(k, t, m, both):
    return t, m, Hold("pause") if 30 <= k < 80 else None


def short_failure(k, t, m, both):
    return t, m, Hold("bumper", failure=True) if 30 <= k < 34 else None


def long_failure(k, t, m, both):
    return t, m, Hold("bumper", failure=True) if 30 <= k < 70 else None


def no_odometry(k, t, m, both):
    if k == 40:
        both.resume()
    return t, m, Hold("no odometry", failure=True, waits=True) if k == 30 else None


def new_limits(k, t, m, both):
    if k == 20:
        both.update(limits={"v": 0.35, "v_slew": 0.7, "omega_slew": 2.0, "corridor": 0.01})
    if k == 45:
        both.update(weights={"across": 90.0, "omega": 9.0, "soft": 4.0})
        both.update(limits={"predicted_omega": 0.4})
    return t, m, None


def no_sensors(k, t, m, both):
    if k == 30:
        both.update(limits={"v_slew": 0.001})
    return t, Measurement() if k >= 30 else m, None


def second_start(k, t, m, both):
    if k == 140:
        # Back to the start: the continuation leads out of the fence.
        both.start(starting_at(load_trajectory("circle"), m.pose.value + [0.0, 0.0, 2.0]), t)
    return t, m, None


def wrong_times(k, t, m, both):
    times = {30: t - 1.0, 50: math.nan, 70: t + 1e6, 90: t - 0.7 * DT, 100: t + 0.004}
    return times.get(k, t), m, None


def clock_set_back(k, t, m, both):
    return t - (1.5 if k >= 30 else 0.0), shift_stamps(m, -1.5 if k >= 30 else 0.0), None


def pause(k, t, m, both):
    if k == 50:
        both.resume()
    return t + (5.0 if k >= 30 else 0.0), shift_stamps(m, 5.0 if k >= 30 else 0.0), None


def leap_twice(k, t, m, both):
    leap = 5.0 * ((k >= 30) + (k >= 31))
    return t + leap, shift_stamps(m, leap), None


class Blocked:
    """Event: the robot is blocked, and its sensor readings do not change."""

    def __call__(self, k, t, m, both):
        if k == 30:
            self.pose = m.pose.value
        if 30 <= k < 130:
            at_rest = Stamped([0.0, 0.0], t), Stamped(0.0, t)
            m = Measurement(Stamped(self.pose, t), *at_rest)
        return t, m, None


def shift_pose(m, offset):
    return m if m.pose is None else replace_parts(m, pose=Stamped(np.asarray(m.pose.value) + offset, m.pose.time))


def shift_stamps(m, delay):
    parts = {name: getattr(m, name) for name in ("pose", "wheel_twist", "yaw_rate")}
    return Measurement(**{n: p and Stamped(p.value, p.time + delay, p.covariance) for n, p in parts.items()})


FENCE = {"fence.enabled": True, "fence.length": 1.7, "fence.width": 1.2}
EVENTS = yaml.safe_load(Path(__file__).with_name("oracle_events.yaml").read_text(encoding="utf-8"))
NAMED_OVERRIDES = {"HARD": HARD, "SOFT": SOFT, "TWO_SIDED": TWO_SIDED, "FENCE": FENCE}


@pytest.mark.parametrize("name", EVENTS)
def test_event_of_a_drive_is_handled_equally(name):
    event, overrides, modes, message = EVENTS[name]
    changes = {}
    for key, value in overrides.items():
        changes |= NAMED_OVERRIDES.get(key, {key: value})
    model, plant = ("ssm", "mujoco") if len(name) % 2 else ("mbm", "model:sm")
    both = pair(model, DAQP_ACCURACY if name in ("updated", "along its limits") else 1e-9, **{"horizon": 15} | changes)
    # Events that change the mode need a full drive; the first seconds are enough for other events.
    max_ticks = {"no pose for long": 190, "blocked": 160, "along its limits": 160, "along limits with two sides": 190}
    ticks = max_ticks.get(name, 70 if modes == ["TRACKING"] else 160)
    both.drive(make_plant(plant, seed=4), load_trajectory("circle"), ticks, eval(event))
    assert message in both.messages
    if modes is not None:
        assert [mode for mode in both.modes if mode in modes][: len(modes)] == modes
        # Without resuming, the last mode remains.
        assert changes.get("failure.resume", True) or both.modes[-1] == modes[-1]


def test_failing_solves_are_handled_equally():
    reference = CorruptedReference(load_trajectory("circle"))
    both = pair(horizon=12, **{"failure.max_reused_ticks": 3})

    def corrupt(k, t, m, both):
        reference.is_corrupted = k in (40, 41) or 80 <= k < 120
        return t, m, None

    both.drive(make_plant("mujoco", seed=2), reference, 150, corrupt)
    assert {both.results[k].solver.status for k in (40, 41)} == {SolverStatus.NOT_FINITE}
    assert not SolverStatus.NOT_FINITE.usable
    recovery = ["TRACKING", "REUSED_PLAN", "BRAKING", "STOPPED", "TRACKING"]
    assert both.modes == ["TRACKING", "REUSED_PLAN", *recovery]


ROUTES = {
    "segments": "start: [1.0, 2.0, 3.0]\nsegments:\n- {v: 0.4, omega: 1.0, duration: 1.0}\n"
    "- {v: 0.0, omega: -1.2, duration: 0.8}\n- {v: 0.0, omega: 0.0, duration: 0.3}\n"
    "- {v: -0.4, omega: 0.3, duration: 0.8}\n",
    "waypoints": "waypoints: [[0, 0], [0.4, 0.05], [0.7, 0.4], [0.5, 0.8]]\nspeed: 0.5\n",
}


@pytest.mark.parametrize("name", ["ssm", "mbm"])
@pytest.mark.parametrize("route", ROUTES)
def test_route_including_its_end_agrees(route, name, tmp_path):
    path = tmp_path / "route.yaml"
    path.write_text(ROUTES[route])
    reference = load_trajectory(path)
    shifted = starting_at(reference, [-1.0, 0.5, 2.5])
    both = pair(name, horizon=15)
    plant = make_plant("mujoco", seed=5)
    both.drive(plant, shifted, math.ceil((reference.duration + 1.5) / DT))
    assert both.modes[0] == "TRACKING"
    assert both.modes[-1] == "FINISHED"


def test_missed_end_position_is_reported_equally():
    both = pair("ssm", horizon=10, **{"finish.position": 1e-6, "finish.timeout": 0.4})
    reference = starting_at(load_trajectory("cane"), [0.0, 0.0, 0.0])
    plant = make_plant("model:ssm", seed=1)
    plant.reset(reference.sample([reference.duration]).pose[0] + [0.005, 0.0, 0.0])
    both.start(reference, plant.time - reference.duration + 0.3)
    for _ in range(60):
        plant.advance(both.step(plant.time, plant.measure()).command)
    assert both.modes[-1] == "FINISHED"
    assert "not at rest within 0.4 s" in both.messages


class SlowRobot(IdealRobot):
    """Robot with a maximum of 0.4 m/s and 0.4 rad/s."""

    def reset(self, pose):
        self.poses = [pose]

    def advance(self, command):
        super().advance(np.clip(command, -0.4, 0.4))


def test_saturated_wheels_are_handled_equally(tmp_path):
    """The wheels saturate after a turn on the spot, and again in the next curve after the limit was dropped."""
    path = tmp_path / "route.yaml"
    segments = (
        "{v: 0.0, omega: 1.0, duration: 1.2}",
        "{v: 0.5, omega: 0.5, duration: 3.0}",
        "{v: 0.1, omega: 0.0, duration: 1.0}",
    )
    path.write_text("\n- ".join(("segments:", *segments)))
    both = pair("sm", horizon=10)
    both.drive(SlowRobot(load_model("sm").discretise(DT), np.zeros(3)), load_trajectory(path), 310)
    is_slow = ["the wheels get no faster" in result.message for result in both.results]
    assert sum(current and not previous for previous, current in pairwise(is_slow)) > 1


def test_restart_and_reset_agree():
    both, plant = pair("sm", horizon=10), make_plant("model:sm", seed=1)
    both.drive(plant, load_trajectory("circle"), 60)
    both.start(load_trajectory("s"), plant.time)
    for _ in range(60):
        plant.advance(both.step(plant.time, plant.measure()).command)
    both.reset()
    both.drive(plant, load_trajectory("square"), 40)


# Single faulty measurements, four ticks each.

SLIP = Slip(
    v_offset=0.03, longitudinal_gain=0.99, yaw_gain=0.7, side_slip=0.06, turn_ahead=0.04, turn_left=-0.03,
    load_shift=0.05,
)  # fmt: skip


def corrupt_pose(change, **options):
    def corrupt(m, queue):
        value, time = change(m.pose.value, m.pose.time)
        return replace_parts(m, pose=Stamped(value, time, **options))

    return corrupt


def replace_wheels(value, **options):
    return lambda m, queue: replace_parts(m, wheel_twist=Stamped(value, m.wheel_twist.time, **options))


def delay_pose(ticks):
    return lambda m, queue: replace_parts(m, pose=queue[-1 - min(ticks, len(queue) - 1)])


CORRUPTIONS = {
    "nothing": lambda m, queue: Measurement(),
    "in time": lambda m, queue: m,
    "pose only": lambda m, queue: Measurement(m.pose),
    "one tick late": delay_pose(1),
    "five ticks late": delay_pose(5),
    "between ticks": corrupt_pose(lambda p, t: (p, t - 0.37 * DT)),
    "in the future": corrupt_pose(lambda p, t: (p, t + 0.3)),
    "too old": corrupt_pose(lambda p, t: (p, t - 3.0)),
    "not finite": corrupt_pose(lambda p, t: ([np.nan, 0.0, 0.0], t)),
    "not numbers": corrupt_pose(lambda p, t: ("here", t)),
    "a list": corrupt_pose(lambda p, t: (p.tolist(), t)),
    "no stamp": corrupt_pose(lambda p, t: (p, None)),
    "false pose": corrupt_pose(lambda p, t: (p + [3.0, 0.0, 0.0], t)),
    "pushed": corrupt_pose(lambda p, t: (p + [0.2, 0.1, 0.3], t)),
    "turned once more": corrupt_pose(lambda p, t: (p + [0.0, 0.0, 2 * np.pi], t)),
    "covariance": corrupt_pose(lambda p, t: (p, t), covariance=np.diag([1e-4, 2e-4, 3e-4]) + 1e-5),
    "bad covariance": corrupt_pose(lambda p, t: (p, t), covariance=np.diag([1e-4, -2e-4, 3e-4])),
    "singular covariance": corrupt_pose(lambda p, t: (p, t), covariance=np.ones((3, 3))),
    "uneven covariance": corrupt_pose(lambda p, t: (p, t), covariance=[[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]),
    "small uneven covariance": corrupt_pose(
        lambda p, t: (p, t), covariance=[[1e-4, 5e-5, 0], [0, 1e-4, 0], [0, 0, 1e-4]]
    ),
    "wheels stopped": replace_wheels([0.0, 0.0]),
    "wheels too fast": replace_wheels([0.1, 40.0]),
    "wheels broken": replace_wheels([np.inf, 0.0]),
    "wheels with covariance": replace_wheels([0.5, 0.1], covariance=np.diag([1e-3, 1e-2])),
    "wheels with a bad covariance": replace_wheels([0.5, 0.1], covariance=[[1e-3, 1.0], [1.0, 1e-3]]),
    "gyro only": lambda m, queue: Measurement(yaw_rate=m.yaw_rate),
    "gyro jumps": lambda m, queue: Measurement(m.pose, yaw_rate=Stamped(6.0, m.yaw_rate.time)),
    "gyro as a list": lambda m, queue: Measurement(m.pose, yaw_rate=Stamped([0.5], m.yaw_rate.time, [[1e-4]])),
}
REASONS = {"not finite": "finite", "in the future": "future", "false pose": "it jumps by 3.0"}
REASONS |= dict.fromkeys(("bad covariance", "uneven covariance", "small uneven covariance"), "covariance")
"""Expected parts of the messages about these faults."""


class EstimatorDrive:
    """Product and oracle on a robot that applies and reports commands different from theirs."""

    def __init__(self, name="ssm", noise=1.0):
        model = load_model(name).with_extra_dead_time([0.01, 0.03])
        self.robot = IdealRobot(model.discretise(DT), np.array([1.0, 2.0, 3.0]), slip=SLIP, noise=noise, seed=3)
        # A short horizon makes solves cheap; without re-entry the robot does not brake for long.
        config = load_config(name, ACTIVE_SET | {"horizon": 6, "reentry.enabled": False})
        self.both = Pair(config, model)
        self.both.start(load_trajectory("circle"), 0.0)
        self.queue, self.sent = [], (0.0, 0.0)

    def tick(self, corruption, *, skip=False, is_reported=True):
        robot, k = self.robot, self.robot.k
        m = robot.measure()
        self.queue.append(m.pose)
        if not skip:
            m = CORRUPTIONS[corruption](m, self.queue)
            self.both.step(robot.time, replace_parts(m, sent=self.sent) if is_reported else m)
        self.sent = (0.5 + 0.2 * np.sin(k / 15), 0.8 * np.sin(k / 25))
        robot.advance(np.array(self.sent))


@pytest.mark.parametrize("offset", [0, 1, 2])
def test_single_faulty_measurements_are_handled_equally(offset):
    drive = EstimatorDrive(noise=0.5)
    for corruption in sorted(CORRUPTIONS)[offset::3]:
        for k in range(14):
            drive.tick(corruption if k < 4 else "in time")
        assert REASONS.get(corruption, "") in drive.both.messages


@settings(max_examples=8)
@example([("false pose", 5)] * 40, "ssm")
@example([("pushed", 5)] * 40, "mbm")
@given(
    st.lists(st.tuples(st.sampled_from(sorted(CORRUPTIONS)), st.integers(0, 9)), min_size=40, max_size=40),
    st.sampled_from(["ssm", "sm", "mbm"]),
)
def test_any_sequence_of_measurements_is_handled_equally(events, name):
    drive = EstimatorDrive(name)
    for corruption, choice in events:
        drive.tick(corruption, skip=choice == 0, is_reported=choice != 1)


def test_measurements_beyond_the_capacity_of_a_sample_are_rejected():
    drive = EstimatorDrive()
    for _ in range(20):
        drive.tick("in time")
    last_time = drive.robot.time - DT
    for index in range(1, 14):
        stamp = last_time + 1e-4 * index
        twist, rate = Stamped([0.5, 0.1], stamp), Stamped(0.3, stamp)
        drive.both.step(last_time + 0.005, Measurement(Stamped(drive.queue[-1].value, stamp), twist, rate))
    for name in ("pose", "wheel speed", "yaw rate"):
        assert f"{name} rejected: too many arrived for one sample" in drive.both.messages
    for _ in range(5):
        drive.tick("in time")
