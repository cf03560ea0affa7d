"""Nav2's action over DDS with a client in another process: goals that succeed, are replaced, cancelled or aborted."""

import subprocess
import sys

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("ros_types")

X = np.linspace(0.0, 2.0, 41)
STRAIGHT = np.column_stack([X, 0 * X, 0 * X])


@pytest.fixture
def parts():
    import follow_parts

    return follow_parts


def staircase(corners, goal, cell=0.05):
    cells = [np.array(corners[0], dtype=float)]
    for corner in corners[1:]:
        first = cells[-1]
        count = round(float(np.abs(np.array(corner) - first).max()) / cell)
        cells += [np.round((first + (np.array(corner) - first) * i / count) / cell) * cell for i in range(1, count + 1)]
    points = np.array(cells)
    return np.column_stack([points, np.append(np.zeros(len(points) - 1), goal)])


def pose(follow):
    return np.asarray(follow.base.plant.true_pose, dtype=float)


def commands_since(follow, start):
    return np.array(follow.base.commands[start:])


def test_grid_path_of_a_planner_is_followed_to_its_goal(parts):
    path = staircase([(0, 0), (1, 0.35), (1, 1.2)], 0.4)
    with parts.following() as follow:
        follow.client.send("a", path)
        positions = []
        follow.until(lambda: positions.append(pose(follow)) or follow.client.result("a"), "the end")
        result = follow.client.result("a")
        assert (result["status"], result["code"]) == (parts.SUCCEEDED, 0)
        assert np.abs(pose(follow) - path[-1]).max() < 0.02
        assert max(np.hypot(*(path[:, :2] - position[:2]).T).min() for position in positions) < 0.05 + 0.05
        messages = follow.client.events_for("a", "feedback")
        distance = [feedback["distance"] for feedback in messages]
        assert len(messages) > 20 and np.all(np.diff(distance) < 0.01)
        assert 1.5 < distance[0] < 2.1 and distance[-1] < 0.05
        assert 0.4 < max(feedback["speed"] for feedback in messages) < 0.7
        # The robot stops and waits at the goal.
        follow.tick(10)
        assert not np.any(follow.base.commands[-1]) and str(follow.made.loop.state) == "IDLE"
        # A repeated goal is reached immediately, even if a timer in the thread of the server fails.
        fault = follow.made.node.parts["follow_path"].server._server_node.create_timer(0.05, lambda: 1 / 0)
        start = len(follow.base.commands)
        follow.client.send("again", path[-2:])
        assert follow.wait_for_end("again")["status"] == parts.SUCCEEDED
        assert np.abs(commands_since(follow, start)[:, 0]).max(initial=0.0) < 0.2
        fault.cancel()


def test_cancelled_goal_brakes_at_the_braking_limits(parts):
    with parts.following({"limits.v_braking": 0.8}) as follow:
        follow.client.send("a", STRAIGHT)
        follow.wait_for_motion()
        follow.until(lambda: follow.base.commands[-1][0] > 0.5, "its speed")
        start = len(follow.base.commands)
        follow.client.write(cancel="a")
        result = follow.wait_for_end("a")
        assert (result["status"], result["code"]) == (parts.CANCELED, 0)
        v = commands_since(follow, start)[:, 0]
        accelerations = np.diff(v)[np.flatnonzero(np.diff(v) < -1e-3)] / parts.DT
        assert accelerations.min() > -0.8 * 1.001 and np.median(accelerations) == pytest.approx(-0.8, rel=0.02)
        assert v[-1] == 0.0 and pose(follow)[0] < 1.8
        stop_pose = pose(follow)
        follow.tick(20)
        assert np.hypot(*(pose(follow) - stop_pose)[:2]) < 5e-3


ZIGZAG = np.column_stack([0.05 * np.arange(3000), 0.05 * np.abs(np.arange(3000) / 5 % 2 - 1) - 0.05, np.zeros(3000)])


REPLACED_MESSAGES = {"a newer goal replaced it before its start", "a newer goal took over"}


def without_result(client, names):
    names_with_result = {event["id"] for event in list(client.events) if event["event"] == "result"}
    return [name for name in names if name not in names_with_result]


def results_by_name(client, names):
    """Return the result of each goal; check that each goal has one response and one result."""
    events_by_name = {name: {"accepted": [], "result": []} for name in names}
    for event in list(client.events):
        if event["event"] in ("accepted", "result"):
            events_by_name[event["id"]][event["event"]].append(event)
    counts = {name: (len(events["accepted"]), len(events["result"])) for name, events in events_by_name.items()}
    assert set(counts.values()) == {(1, 1)}
    return {name: events["result"][0] for name, events in events_by_name.items()}


@pytest.mark.parametrize(
    ("goals", "rate", "path"),
    [
        (40, 100.0, np.repeat(3.0 * STRAIGHT, 25, axis=0)),
        pytest.param(1000, 200.0, np.repeat(3.0 * STRAIGHT, 5, axis=0), marks=pytest.mark.long),
        pytest.param(300, 100.0, ZIGZAG, marks=pytest.mark.long),
    ],
    ids=["1000 poses", "a thousand", "zigzag"],
)
def test_each_goal_of_a_fast_burst_has_one_response_and_one_result(parts, goals, rate, path):
    """Goals with many poses arrive faster than they are read; only the last goal is followed to its end."""
    with parts.following() as follow:
        names = follow.client.burst("a", [{"poses": path}], times=goals, rate=rate)
        follow.until(
            lambda: without_result(follow.client, names) in ([], names[-1:]), "all but the last", max_ticks=30 * goals
        )
        if without_result(follow.client, names):
            follow.client.write(cancel=names[-1])
        follow.wait_for_end(names[-1])
        ends = {(result["status"], result["words"]) for result in results_by_name(follow.client, names).values()}
        # On a slow computer the robot reaches the end before the last goal arrives.
        assert ends <= {
            (parts.CANCELED, "cancelled"),
            (parts.SUCCEEDED, ""),
            *((parts.ABORTED, message) for message in REPLACED_MESSAGES),
        }
        assert not np.any(follow.base.commands[-1])


# Path for a drive of more than 25 s at 0.6 m/s.
LONG = np.column_stack([np.linspace(0.0, 20.0, 401), np.zeros((401, 2))])
SPEED = 0.59


def wait_for_speed(follow, pace):
    follow.until(lambda: follow.base.commands[-1][0] > SPEED, "its speed", pace=pace)


@pytest.mark.parametrize("method", ["terminate", "kill"])
@pytest.mark.parametrize("distance", [1.0, 0.6])
def test_robot_brakes_within_the_blind_distance_of_an_ended_client(parts, method, distance):
    with parts.following(follow_blind_distance=distance) as follow:
        follow.client.send("a", LONG)
        wait_for_speed(follow, parts.DT)
        start = len(follow.base.commands)
        getattr(follow.client.process, method)()
        follow.until(lambda: follow.client.process.poll() is not None, "the end of the client", pace=parts.DT)
        x = pose(follow)[0]
        follow.until(lambda: not np.any(follow.base.commands[-1]), "the stop", pace=parts.DT)
        limits = follow.made.node._controller.config.limits
        braking = np.array([limits.v_braking, limits.omega_braking]) * parts.DT
        assert (np.abs(np.diff(commands_since(follow, start), axis=0)) <= braking * 1.001).all()
        assert pose(follow)[0] < x + distance


def test_goal_is_aborted_without_odometry_or_progress(parts):
    with parts.following({"reentry.blocked_after": 0.3}, blocked_timeout=0.6) as follow:
        follow.client.send("a", STRAIGHT)
        follow.wait_for_motion()
        follow.base.tamper = lambda odometry: None
        result = follow.wait_for_end("a")
        assert (result["status"], result["code"]) == (parts.ABORTED, 102)
        assert "odometry is" in result["words"]
        assert not np.any(follow.base.commands[-1])
        # With odometry, the node accepts the next goal.
        follow.base.tamper = lambda odometry: odometry
        follow.tick(5)
        follow.client.send("b", STRAIGHT)
        follow.until(lambda: follow.base.commands[-1][0] > 0.2, "the robot drives")
        follow.base.held = True
        result = follow.wait_for_end("b")
        assert (result["status"], result["code"]) == (parts.ABORTED, 105)
        assert "blocked" in result["words"]
        assert not np.any(follow.base.commands[-1])


def test_node_drives_without_the_action_type():
    code = (
        "import sys; sys.modules['nav2_msgs'] = None\n"
        "from ros_parts import stack\n"
        "with stack(drive=True) as made:\n"
        "    made.base.run(30)\n"
        "    print(max(v for v, _ in made.base.commands) > 0.2, made.node.parts['follow_path'].server)\n"
    )
    folder = __file__.rpartition("/")[0]
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder, check=False)
    assert process.stdout.strip() == "True None", process.stderr
