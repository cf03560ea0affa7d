"""Judge of the monitor: violations of each rule, valid drives, and a comparison with the oracle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from judge_oracle import OracleJudge

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc_monitor.judge import Judge, load_judge
from diffdrive_mpc_monitor.rules import FOLDER, Rules, load_rules

DT = 0.0202
START = 1000.0
RULES = load_rules()


class Robot:
    """Robot with a lag of 0.1 s on a straight reference; tests set its faults."""

    def __init__(self, judge, speed=0.4, duration=10.0):
        self.judge, self.now, self.speed = judge, START, speed
        times = np.linspace(0.0, duration, round(20 * duration) + 1)
        distance = speed * times
        self.points = np.column_stack([START + times, distance, 0 * times, 0 * times]).tolist()
        judge.reference(self.now, self.points)
        self.state, self.twist, self.out = np.zeros(3), np.zeros(2), (0.0, 0.0)
        self.ignores_commands = self.has_no_odometry = self.has_no_pose = False
        self.gyro_scale = 1.0

    def drive(self, seconds, command=None, stamp=None, is_silent=False):
        """Drive for a time; return the commands (n, 2) of the base."""
        commands = []
        for _ in range(round(seconds / DT)):
            judge, now = self.judge, self.now
            if not self.has_no_odometry:
                judge.gyro(now, now, self.gyro_scale * self.twist[1])
                judge.odometry(now, now, self.twist.tolist(), self.state.tolist())
            if not self.has_no_pose:
                judge.pose(now, now, self.state.tolist())
            v = min(self.speed, 1.9 * (now - START)) if command is None else command[0]
            if not is_silent:
                self.out = judge.command(now, now if stamp is None else stamp(now), v, command[1] if command else 0.0)
            stop_command = judge.tick(now)
            self.out = self.out if stop_command is None else stop_command
            commands.append(self.out)
            if not self.ignores_commands:
                self.twist = self.twist + 0.2 * (np.array(self.out) - self.twist)
            x, y, theta = self.state
            v, omega = self.twist
            self.state = np.array([x + DT * v * math.cos(theta), y + DT * v * math.sin(theta), theta + DT * omega])
            self.now += DT
        return np.array(commands)


REST = (0.0, 0.0)


def stand(robot):
    robot.drive(1.0, REST)


def finish(robot):
    """Report that the controller drives and then stops, and stand still for a second."""
    robot.judge.says(robot.now, drives=True)
    robot.judge.reference(robot.now, [[robot.now, *robot.state], [robot.now + 20.0, *robot.state]])
    robot.judge.says(robot.now, drives=False)
    stand(robot)


@pytest.fixture
def robot():
    return Robot(Judge(RULES, START))


def test_commands_of_a_valid_drive_are_unchanged(robot):
    commands = robot.drive(10.0)
    assert not robot.judge.verdict
    assert commands[-1].tolist() == [0.4, 0.0]
    assert robot.drive(1.0, (0.0, 0.0))[0].tolist() == [0.0, 0.0]
    assert not robot.judge.verdict


def test_disabled_gyro_is_not_used_to_predict_the_path():
    verdicts = []
    for scale in (1.0, -2.0):
        robot = Robot(Judge(RULES.with_sensors(pose=True, gyro=False), START))
        robot.gyro_scale = scale
        robot.drive(2.0)
        robot.drive(3.0, (0.4, 0.3))
        verdicts.append(robot.judge.verdict)
    assert verdicts[0] == verdicts[1] and verdicts[0].rule == "off_path"


@pytest.mark.parametrize("v", [math.nan, math.inf, -math.inf])
def test_non_finite_commands_are_not_forwarded_to_the_base(robot, v):
    robot.drive(2.0)
    commands = robot.drive(1.0, (v, 0.0))
    assert robot.judge.verdict.rule == "not_finite"
    assert np.isfinite(commands).all()
    assert np.all(np.diff(commands[:, 0]) <= 0) and commands[-1, 0] == 0.0


@pytest.mark.parametrize("sensor", ["pose", "odometry", "gyro"])
@pytest.mark.parametrize("defect", ["not finite", "in the future", "repeated"])
def test_invalid_readings_are_ignored(robot, sensor, defect):
    """Valid readings in between keep the robot driving; without them the sensor data becomes too old."""

    def send(index):
        values = [*robot.twist, *robot.state]
        values = {"pose": values[2:], "odometry": values, "gyro": values[1:2]}[sensor]
        stamp = {"in the future": robot.now + 5.0, "repeated": valid_stamp}.get(defect, robot.now)
        if defect == "not finite":
            values[index % len(values)] = (math.nan, math.inf)[index % 2]
        data = {"pose": [values], "odometry": [values[:2], values[2:]], "gyro": values}[sensor]
        getattr(robot.judge, sensor)(robot.now, stamp, *data)

    for index in range(100):
        valid_stamp = robot.now
        robot.drive(DT)
        send(index)
    assert not robot.judge.verdict
    end = robot.now + getattr(RULES.sensors, f"{sensor}_age")
    setattr(robot, "has_no_pose" if sensor == "pose" else "has_no_odometry", True)
    for _ in range(250):
        for part in range(5 if defect == "not finite" else 1):
            send(part)
        # `has_no_odometry` disables both sensors; send valid readings of the other sensor.
        if sensor == "gyro":
            robot.judge.odometry(robot.now, robot.now, robot.twist.tolist(), robot.state.tolist())
        if sensor == "odometry":
            robot.judge.gyro(robot.now, robot.now, robot.twist[1])
        robot.drive(DT)
    assert robot.judge.verdict.rule == sensor and robot.judge.verdict.at == pytest.approx(end, abs=2 * DT)


def test_robot_brakes_at_the_braking_limits_and_remains_stopped(robot):
    robot.drive(2.0)
    commands = robot.drive(1.0, (1.6, 0.0))[:, 0]
    assert robot.judge.verdict.rule == "speed"
    braking = commands[commands > 0]
    assert len(braking) == pytest.approx(0.4 / (RULES.commands.v_braking * DT), abs=1)
    assert np.abs(np.diff([0.4, *braking])).max() <= RULES.commands.v_braking * DT + 1e-12
    # Valid commands do not resume the drive without a reset.
    assert not robot.drive(2.0, (0.0, 0.0)).any() and not robot.drive(0.5, (0.01, 0.0)).any()
    assert robot.judge.verdict.words == "a command is too fast: 1.6 m/s, the limit is 1.5 m/s"


def test_robot_with_wrong_response_is_stopped_without_a_ramp(robot):
    """A braking ramp would continue the wrong motion."""
    robot.drive(2.0)
    robot.ignores_commands = True
    robot.twist = np.array([-0.5, 0.0])
    commands = robot.drive(0.5)
    assert robot.judge.verdict.rule == "answer_v"
    first = np.flatnonzero(commands[:, 0] == 0.0)[0]
    assert commands[first - 1, 0] == 0.4


@pytest.mark.parametrize(
    ("rule", "violate"),
    [
        ("silent", lambda r: r.drive(0.5, is_silent=True)),
        ("old_command", lambda r: r.drive(0.1, stamp=lambda now: now - 0.3)),
        ("command_ahead", lambda r: r.drive(0.1, stamp=lambda now: now + 0.3)),
        ("slew", lambda r: r.drive(0.1, (0.9, 0.0))),
        ("yaw_slew", lambda r: r.drive(0.1, (0.4, 1.5))),
        ("yaw_rate", lambda r: r.drive(0.1, (0.4, 2.1))),
        ("not_to_move", lambda r: (r.judge.says(r.now, drives=False), r.drive(2.0))),
        (
            "creeps",
            lambda r: (
                finish(r),
                setattr(r, "ignores_commands", True),
                r.twist.__setitem__(0, 0.029),
                r.drive(2.0, REST),
            ),
        ),
        ("creeps", lambda r: (finish(r), r.drive(2.2, (-0.029, 0.0)))),
        ("turns_at_rest", lambda r: (finish(r), r.drive(4.0, (0.0, 0.07)))),
        ("strays", lambda r: (stand(r), r.judge.reference(r.now, r.points[:41]), r.drive(8.0, (0.04, 0.0)))),
        ("strays", lambda r: (r.judge.says(r.now, drives=True), r.drive(7.5, (0.34, 0.0)))),
        ("off_path", lambda r: (r.judge.says(r.now, drives=True), stand(r), r.drive(1.5, (0.0, 0.0)))),
        ("odometry", lambda r: (setattr(r, "has_no_odometry", True), r.drive(0.5))),
        ("pose", lambda r: (setattr(r, "has_no_pose", True), r.drive(3.0))),
        ("no_reference", lambda r: (r.judge.reference(r.now, []), r.drive(0.5))),
        ("bad_reference", lambda r: r.judge.reference(r.now, [[r.now, 0, 0, 0], [r.now + 1, 5, 0, 0]])),
        ("outside", lambda r: r.judge.outside(r.now, wrong=True)),
        ("off_heading", lambda r: (stand(r), r.judge.reference(r.now, [[r.now, *r.state]]), r.drive(4.5, (0.0, 0.3)))),
        ("pose_jumps", lambda r: (r.state.__setitem__(1, 0.6), r.drive(1.0))),
        ("pose_turns", lambda r: (r.state.__setitem__(2, 0.7), r.drive(0.6))),
        ("clock", lambda r: r.judge.tick(r.now - 5.0)),
    ],
)
def test_each_rule_stops_the_robot(robot, rule, violate):
    robot.drive(2.0)
    assert not robot.judge.verdict
    violate(robot)
    assert robot.judge.verdict.rule == rule
    assert "\n" not in robot.judge.verdict.words and len(robot.judge.verdict.words) > 10


@pytest.mark.parametrize(
    ("command", "rule"), [((0.25, 0.0), ""), ((-0.25, 0.0), "speed"), ((0.0, 0.4), ""), ((0.0, -0.4), "yaw_rate")]
)
def test_reverse_and_right_turns_have_limits_of_their_own(command, rule):
    update = {"v": 0.5, "v_reverse": 0.2, "omega": 0.5, "omega_right": 0.3}
    robot = Robot(Judge(RULES.model_copy(update={"commands": RULES.commands.model_copy(update=update)}), START), 0.0)
    for share in np.linspace(0.0, 1.0, 20):
        robot.drive(DT, tuple(share * np.array(command)))
    assert robot.judge.verdict.rule == rule if rule else not robot.judge.verdict


@pytest.mark.parametrize("has_driven", [True, False])
def test_robot_is_pushed_before_but_not_after_a_drive(has_driven):
    """After a reset, the robot may be pushed by the same distance again."""
    robot = Robot(Judge(RULES, START))
    robot.judge.says(robot.now, drives=has_driven)
    robot.drive(1.0, REST)
    robot.judge.says(robot.now, drives=False)
    robot.ignores_commands, robot.twist = True, np.array([0.1, 0.0])
    robot.drive(0.45, REST)
    assert not robot.judge.verdict
    robot.drive(0.2, REST)
    assert robot.judge.verdict.rule == ("creeps" if has_driven else "")
    robot.twist[0] = 0.0
    stand(robot)
    assert not robot.judge.reset(robot.now)
    stand(robot)
    assert not robot.judge.verdict


def test_stopping_distance_and_pose_jumps_do_not_count_as_motion_at_rest(robot):
    """The controller reports standstill while the robot still drives at full speed."""
    robot.drive(2.0)
    robot.judge.says(robot.now, drives=True)
    robot.judge.says(robot.now, drives=False)
    start = robot.state[0]
    robot.drive(2.0, REST)
    assert robot.state[0] - start > 0.03
    robot.state[1] += 0.1
    robot.drive(5.0, REST)
    assert not robot.judge.verdict


def test_blocked_robot_may_be_late(robot):
    """A blocked robot is slower than commanded, which is not a fault of the controller."""
    robot.drive(2.0)
    robot.twist, robot.ignores_commands = np.zeros(2), True
    robot.drive(3.0)
    robot.ignores_commands = False
    robot.drive(4.0)
    assert not robot.judge.verdict


def pause(robot, seconds):
    """Report a stop, stop for `seconds`, and accelerate again from rest."""
    robot.judge.says(robot.now, drives=False)
    robot.drive(seconds, (0.0, 0.0))
    robot.judge.says(robot.now, drives=True)
    for v in np.arange(0.0, robot.speed, 1.9 * DT):
        robot.drive(DT, (v, 0.0))


def test_robot_may_be_late_after_a_standstill():
    """The reference advances during the standstill."""
    robot = Robot(Judge(RULES, START), duration=30.0)
    robot.judge.says(robot.now, drives=True)
    robot.drive(2.0)
    pause(robot, 3.0)
    robot.drive(10.0)
    assert not robot.judge.verdict


@pytest.mark.parametrize(("is_renewed", "rule"), [(True, ""), (False, "off_path")])
def test_robot_needs_a_shifted_reference_after_a_long_standstill(is_renewed, rule):
    """If the reference is delayed by the standstill, the robot is on time; later delays are detected."""
    robot = Robot(Judge(RULES, START), duration=30.0)
    robot.judge.says(robot.now, drives=True)
    robot.drive(2.0)
    delay = 60.0
    if is_renewed:
        robot.judge.reference(robot.now, [[t + delay, *pose] for t, *pose in robot.points])
    pause(robot, delay)
    robot.drive(10.0)
    assert robot.judge.verdict.rule == rule
    if is_renewed:
        robot.drive(4.0, (0.0, 0.0))
        assert robot.judge.verdict.rule == "off_path"


@pytest.mark.parametrize("renewed", ["reference", "word", "motion", "nothing"])
def test_robot_that_never_returns_is_stopped_in_time(renewed):
    """The time off the path is limited, independent of the messages that arrive."""
    robot = Robot(Judge(RULES, START), duration=60.0)
    robot.judge.says(robot.now, drives=True)
    robot.drive(2.0)
    for _ in range(10):
        robot.state[1] += 0.025
        robot.drive(DT)
    start_time = robot.now
    while not robot.judge.verdict and robot.now < start_time + 40.0:
        robot.drive(0.5)
        if renewed == "reference":
            robot.judge.reference(robot.now, robot.points)
        elif renewed == "word":
            robot.judge.says(robot.now, drives=False)
            robot.judge.says(robot.now, drives=True)
        elif renewed == "motion":
            robot.state[1] = 0.5 - robot.state[1]
    assert robot.judge.verdict.rule in ("strays", "off_path")
    assert robot.judge.verdict.at - start_time <= RULES.returning.within + RULES.path.lasting + 0.1


@pytest.mark.parametrize(("motion", "rule"), [(0.25, ""), (0.6, "pose_jumps")])
def test_robot_may_return_after_an_external_motion(robot, motion, rule):
    """The allowed external motion is limited."""
    robot.drive(2.0)
    for _ in range(10):
        robot.state[1] += 0.1 * motion
        robot.drive(DT)
    robot.drive(0.5)
    while robot.state[1] > 0.01 and not robot.judge.verdict:
        robot.state[1] -= 0.002
        robot.drive(DT)
    robot.drive(1.0)
    assert robot.judge.verdict.rule == rule


def test_zero_command_is_always_accepted(robot):
    """A controller may stop at any time, speed and stamp."""
    robot.drive(2.0)
    robot.drive(0.1, (0.0, 0.0), stamp=lambda now: now - 5.0)
    assert not robot.judge.verdict


def test_burst_of_late_messages_is_not_a_jump():
    """Five commands that arrive together after 0.1 s are a valid ramp by their stamps."""
    judge = Judge(RULES, START)
    now = START
    judge.reference(now, [[START, 0, 0, 0], [START + 9, 9, 0, 0]])
    for k in range(1, 60):
        arrival = now + DT * (k - k % 5 + 5)
        judge.gyro(arrival, arrival, 0.0)
        judge.odometry(arrival, arrival, (0.0, 0.0), (0.0, 0.0, 0.0))
        judge.pose(arrival, arrival, (0.0, 0.0, 0.0))
        judge.command(arrival, now + DT * k, 0.5 * DT * k, 0.0)
    assert not judge.verdict


def test_reset_succeeds_when_the_cause_is_gone(robot):
    robot.drive(2.0)
    robot.drive(0.2, (1.6, 0.0))
    assert robot.judge.reset(robot.now).rule == "still_moved"
    robot.drive(1.0, (0.0, 0.0))
    assert not robot.judge.reset(robot.now)
    assert not robot.judge.verdict
    commands = robot.drive(0.5, (0.02, 0.0))
    assert commands[-1, 0] == 0.02 and not robot.judge.verdict


def test_reset_fails_while_sensor_data_is_missing(robot):
    robot.drive(2.0)
    robot.has_no_odometry = True
    robot.drive(1.0)
    robot.drive(1.0, (0.0, 0.0))
    assert robot.judge.reset(robot.now).rule == "odometry"
    robot.has_no_odometry = False
    robot.drive(0.5, (0.0, 0.0))
    assert not robot.judge.reset(robot.now)


@pytest.mark.parametrize(("offset", "rule"), [(0.9, "no_reference"), (1.2, "no_reference"), (0.3, "")])
def test_robot_far_from_its_path_needs_a_new_reference(offset, rule):
    """A reset discards the reference of a robot beyond the returning distance."""
    robot = Robot(Judge(RULES, START))
    robot.drive(2.0)
    robot.state[1] = 0.9
    robot.drive(3.0)
    assert robot.judge.verdict.rule == "pose_jumps"
    robot.state[1] = offset
    robot.drive(3.0, (0.0, 0.0))
    robot.judge.reference(robot.now, [[t + 6.0, *pose] for t, *pose in robot.points])
    assert not robot.judge.reset(robot.now)
    robot.drive(1.0, (0.04, 0.0))
    assert robot.judge.verdict.rule == rule


def random_drive(seed):
    """Yield the calls of a drive with a fault: name, arguments. The start of the drive is valid.

    From seed 18 on the drive contains a standstill, and from seed 26 on the robot creeps during it.
    """
    rng = np.random.default_rng(seed)
    fault, standstill = seed % 12, 4.0 if seed >= 26 else 1.0 if seed >= 18 else 0.0
    now, state, twist, command = START, np.zeros(3), np.zeros(2), np.zeros(2)
    yaw_rate = rng.uniform(-0.5, 0.5)
    times = np.arange(0.0, 6.01, 0.1)
    heading = yaw_rate * times
    speed = rng.uniform(0.2, 0.5)
    x = np.cumsum(speed * 0.1 * np.cos(heading)) - speed * 0.1
    y = np.cumsum(speed * 0.1 * np.sin(heading))
    yield "reference", (START, np.column_stack([START + times, x, y, heading]).tolist()), {}
    fault_start, is_driving = rng.uniform(0.8, 1.5) + 1.5 * standstill, True
    for _ in range(round(250 * (1.0 + 0.5 * standstill))):
        t = now - START
        was_driving, is_driving = is_driving, not 1.0 <= t < 1.0 + standstill
        if is_driving and not was_driving and seed % 2:
            restart = START + standstill
            yield "reference", (now, np.column_stack([restart + times, x, y, heading]).tolist()), {}
        is_faulty = t > fault_start
        target = np.array([speed, yaw_rate]) * (t < 6.0 + standstill and is_driving)
        if seed >= 26 and not is_driving:
            target = np.array([0.028, 0.0] if seed % 2 else [0.0, 0.075])
        if is_faulty:
            target = {
                0: target * [1, -1],
                1: target * [-1, 1],
                2: command,
                3: target + [0.9, 0],
                4: target + [0, 1.9],
                5: target * 0 + 0.2,
            }.get(fault, target)
        command = command + np.clip(target - command, [-2 * DT, -6 * DT], [2 * DT, 6 * DT])
        if fault == 6 and is_faulty:
            command = command + rng.normal(0, 0.1, 2)
        noise = rng.normal(0.0, 0.01, 3)
        if not (fault == 7 and is_faulty):
            yield "gyro", (now, now, float(twist[1] * (-2.0 if fault == 8 and is_faulty else 1.0) + noise[0])), {}
            yield "odometry", (now, now, (twist + noise[:2]).tolist(), state.tolist()), {}
        if rng.random() < 0.4:
            measured = np.zeros(3) if fault == 9 and is_faulty else state
            yield "pose", (now, now - 0.03, (measured + noise).tolist()), {}
        yield "says", (now,), {"drives": is_driving and not (fault == 10 and is_faulty)}
        if not (fault == 11 and is_faulty and rng.random() < 0.8):
            yield "command", (now, now if fault % 2 else 0.0, *map(float, command)), {}
        yield "tick", (now,), {}
        twist = twist + 0.2 * (command - twist)
        v, omega = twist
        state = state + DT * np.array([v * math.cos(state[2]), v * math.sin(state[2]), omega])
        now += DT


@pytest.mark.parametrize("seed", [*range(20), *range(24, 28)])
def test_oracle_agrees_with_the_judge(seed):
    """Compare stop, time and rule after each call."""
    rules = RULES if seed < 12 or seed >= 18 else RULES.with_sensors(pose=False, gyro=seed % 2 == 0)
    judge, oracle = Judge(rules, START), OracleJudge(rules, START)
    for name, arguments, keywords in random_drive(seed):
        getattr(judge, name)(*arguments, **keywords)
        getattr(oracle, "odometry_" if name == "odometry" else name)(*arguments, **keywords)
        result = judge.verdict
        assert bool(result) == (oracle.stopped is not None), (name, arguments, result, oracle.stopped)
        if result:
            assert result.at == oracle.stopped[0] and result.rule in oracle.stopped[1]
            break


def test_random_drives_violate_many_rules():
    rules = set()
    for seed in range(18):
        judge = Judge(RULES if seed < 12 else RULES.with_sensors(pose=False, gyro=seed % 2 == 0), START)
        for name, arguments, keywords in random_drive(seed):
            getattr(judge, name)(*arguments, **keywords)
        rules.add(judge.verdict.rule)
    assert len(rules - {""}) >= 6, rules


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("commands.slowest: 0.001", "commands.quickest must be shorter than commands.slowest"),
        ("commands.vv: 1", "did you mean 'commands.v'"),
        ("path.distance: .nan", "path.distance"),
    ],
)
def test_invalid_rules_raise_a_one_line_error(tmp_path, text, message):
    import yaml

    values = yaml.safe_load((FOLDER / "default.yaml").read_text(encoding="utf-8"))
    key, _, value = text.partition(": ")
    group, name = key.split(".")
    values[group][name] = yaml.safe_load(value)
    path = tmp_path / "rules.yaml"
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    with pytest.raises(ConfigError) as error:
        load_rules(path)
    assert message in str(error.value) and "\n" not in str(error.value) and str(path) in str(error.value)


def test_rules_and_the_c_struct_have_equal_names():
    ffi, _ = load_judge()
    fields = [name for name, _ in ffi.typeof("ddmon_rules").fields]
    assert fields == list(RULES.numbers)
    assert all(field.description for field in Rules.model_fields.values())
