"""Driving among obstacles, with ideal and noisy robots; all gaps are true gaps."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from ideal_robot import IdealRobot
from nonlinear_program import EXACT, NO_SLIP, iterate_to_convergence, record, solve_with_ipopt

from diffdrive_mpc import Controller, ControllerConfig, load_config, load_trajectory, make_plant
from diffdrive_mpc.models.interface import ReferenceSample
from diffdrive_mpc.mpc import Mode
from diffdrive_mpc_extras.free_space import Corridor, MovingDisc, OccupancyGrid, Surroundings, SurroundingsError
from diffdrive_mpc_extras.free_space.config import free_space_of
from diffdrive_mpc_extras.free_space.pieces import PlacedFootprint, build_pieces, min_gaps
from diffdrive_mpc_extras.free_space.polygons import Footprint

MAX_GAP = 5.0
AT_REST = 0.02


def config(**free_space):
    return ControllerConfig.model_validate({"free_space": {"enabled": True, **free_space}})


class Line:
    """Straight reference from rest to rest."""

    name = "line"

    def __init__(self, length, speed=0.4, acceleration=0.4):
        self.length, self.speed, self.acceleration = length, speed, acceleration
        self.duration = length / speed + speed / acceleration

    def sample(self, times):
        t = np.clip(np.asarray(times, dtype=float).reshape(-1), 0.0, self.duration)
        left, ramp, a = self.duration - t, self.speed / self.acceleration, self.acceleration
        v = np.minimum(np.minimum(a * t, self.speed), a * left)
        middle = self.speed * (t - 0.5 * ramp)
        x = np.where(t < ramp, 0.5 * a * t**2, np.where(left < ramp, self.length - 0.5 * a * left**2, middle))
        zeros = np.zeros_like(x)
        return ReferenceSample(np.stack([x, zeros, zeros], axis=1), np.stack([v, zeros], axis=1), x)


def box(x, y, length, width):
    return np.array([[x, y], [x + length, y], [x + length, y + width], [x, y + width]]) - 0.5 * np.array(
        [length, width]
    )


def post(x, y, radius, corners=12):
    angle = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)


def drive(controller, reference, surroundings_at, duration, *, plant="model:ssm", sensors=None, seed=0):
    """Return ticks as dictionaries: time, pose, speed, true gap, step.

    `surroundings_at` returns the surroundings at a time, or None if they do not change.
    """
    robot = make_plant(plant, seed=seed, **({} if sensors is None else {"sensors": sensors}))
    robot.reset(reference.sample([0.0]).pose[0])
    controller.start(reference, robot.time)
    settings = controller.config.features["free_space"]
    footprint = PlacedFootprint(Footprint(settings.corners, settings.footprint_radius))
    ticks, current, pieces = [], None, None
    for _ in range(int(duration / robot.sample_time)):
        t = robot.time
        result = surroundings_at(t)
        if result is not None:
            controller.feature("free_space").set_obstacles(result)
            current, pieces = result, build_pieces(result, settings, reference)
        step = controller.step(t, robot.measure())
        age = 0.0 if current.time is None else t - current.time
        (gap,), _ = min_gaps(footprint, pieces, np.array([robot.true_pose]), np.array([age]), MAX_GAP)
        speed = abs(robot.true_twist[0]) + abs(robot.true_twist[-1]) * footprint.footprint.reach
        ticks.append({"t": t, "pose": np.array(robot.true_pose), "speed": speed, "gap": gap, "step": step})
        assert np.isfinite(step.command).all()
        robot.advance(step.command)
        if step.mode is Mode.FINISHED and speed < AT_REST:
            break
    return ticks


def at_start(surroundings):
    return lambda t: surroundings if t < 1e-9 else None


def column(ticks, name):
    return np.array([tick[name] for tick in ticks])


def min_gap_while_moving(ticks):
    return min((tick["gap"] for tick in ticks if tick["speed"] > AT_REST), default=MAX_GAP)


@cache
def post_drive(y):
    return drive(Controller(config()), Line(4.0), at_start(Surroundings([post(2.0, y, 0.1)])), 20.0)


@pytest.mark.parametrize("y", [-0.1, 0.0, 0.03, 0.2])
def test_robot_passes_a_post_on_one_side_without_contact(y):
    ticks = post_drive(y)
    assert ticks[-1]["step"].mode is Mode.FINISHED
    assert np.hypot(*(ticks[-1]["pose"] - [4.0, 0.0, 0.0])[:2]) < 0.03
    assert column(ticks, "gap").min() > 0.03
    # The robot passes on the wide side and stays on this side of the path.
    offset = column(ticks, "pose")[:, 1]
    assert min(abs(offset.min()), abs(offset.max())) < 0.03
    if y:
        assert np.sign(offset[np.abs(offset).argmax()]) == -np.sign(y)


def test_noise_does_not_change_the_side_of_the_path():
    """Use a post in the middle of the path, noisy poses, and surroundings with 1 mm of noise."""
    rng = np.random.default_rng(5)
    plan_sides = []

    def surroundings_at(t):
        return Surroundings([post(2.0, rng.normal(scale=0.001), 0.1)], time=t)

    ticks = drive(Controller(config()), Line(3.5), surroundings_at, 18.0, seed=3)
    for tick in ticks:
        plan = tick["step"].plan
        if plan is not None and abs(plan[-1, 1]) > 0.1 and plan[-1, 0] < 2.0:
            plan_sides.append(np.sign(plan[-1, 1]))
    assert len(set(plan_sides)) == 1
    assert column(ticks, "gap").min() > 0.02


def test_robot_passes_a_doorway_with_ten_centimetres_of_clearance():
    cells = np.zeros((160, 80), dtype=np.int8)
    cells[:, 36:42] = 100
    cells[75:85, 36:42] = 0
    door = Surroundings(grid=OccupancyGrid(cells, 0.05, (0.0, -4.0, 0.0)))
    ticks = drive(Controller(config(margin=0.015)), Line(3.5, 0.3), at_start(door), 22.0)
    assert ticks[-1]["step"].mode is Mode.FINISHED
    assert column(ticks, "gap").min() > 0.015


def test_robot_stops_before_a_doorway_that_is_too_narrow():
    door = Surroundings([box(1.5, 2.2, 0.2, 4.0), box(1.5, -2.2, 0.2, 4.0)])
    ticks = drive(Controller(config(margin=0.03)), Line(3.0, 0.3), at_start(door), 12.0)
    last = ticks[-1]["step"]
    assert last.mode is Mode.STOPPED
    assert "no way" in last.message
    assert column(ticks, "gap").min() > 0.02


def test_robot_stops_at_a_blocked_path_and_continues_when_it_is_free():
    wall = Surroundings([box(2.5, 0.0, 0.4, 4.0)])

    def surroundings_at(t):
        return wall if t < 1e-9 else Surroundings() if abs(t - 12.0) < 0.0102 else None

    ticks = drive(Controller(config()), Line(4.0), surroundings_at, 26.0)
    blocked_ticks = [tick for tick in ticks if tick["t"] < 11.9]
    assert blocked_ticks[-1]["step"].mode is Mode.STOPPED
    assert blocked_ticks[-1]["step"].message.startswith("no way: blocked by polygon 0")
    assert 0.02 < min(tick["gap"] for tick in blocked_ticks) < 0.2
    assert blocked_ticks[-1]["step"].command.tolist() == [0.0, 0.0]
    assert blocked_ticks[-1]["step"].progress == 0.0
    assert ticks[-1]["step"].mode is Mode.FINISHED
    assert np.hypot(*(ticks[-1]["pose"] - [4.0, 0.0, 0.0])[:2]) < 0.03


def test_robot_brakes_for_a_suddenly_appearing_wall():
    """A wall appears just beyond the stopping distance."""
    empty, wall = Surroundings(), Surroundings([box(2.13, 0.0, 0.2, 4.0)])

    def surroundings_at(t):
        return empty if t < 1e-9 else wall if abs(t - 3.0) < 0.0102 else None

    ticks = drive(Controller(config()), Line(4.0, 0.6, 0.8), surroundings_at, 6.0)
    assert min(tick["gap"] for tick in ticks if tick["t"] > 3.02) > 0.0
    assert ticks[-1]["step"].mode is Mode.STOPPED


def test_stopping_path_check_brakes_if_the_reference_does_not_wait():
    """If re-entry is off, the reference continues into the wall, and only the check after the solve brakes."""
    without_reentry = ControllerConfig.model_validate({"free_space": {"enabled": True}, "reentry": {"enabled": False}})
    wall = Surroundings([box(2.5, 0.0, 0.4, 4.0)])
    controller = Controller(without_reentry)
    controller._features["free_space"]._keeper._plan_path = lambda t, time: ""
    ticks = drive(controller, Line(4.0, 0.6, 0.8), at_start(wall), 7.0)
    messages = [tick["step"].message for tick in ticks if tick["step"].mode in (Mode.BRAKING, Mode.STOPPED)]
    assert any("the stopping path comes within" in message for message in messages)
    assert column(ticks, "gap").min() > 0.015
    assert min_gap_while_moving(ticks) > 0.015
    obstacles = [tick["step"].pressed_by for tick in ticks if tick["step"].pressed_by]
    assert obstacles
    assert obstacles[0][0].startswith("polygon 0 in ")


@pytest.mark.parametrize("seed", range(6))
def test_moving_robot_never_touches_a_crossing_disc(seed):
    rng = np.random.default_rng(seed)
    speed, side = rng.uniform(0.3, 1.4), rng.choice([-1.0, 1.0])
    arrival, x = rng.uniform(3.0, 6.0), rng.uniform(1.2, 2.5)
    radius, vx = rng.uniform(0.2, 0.35), rng.uniform(-0.3, 0.3)

    def surroundings_at(t):
        return Surroundings(
            discs=[MovingDisc(x + vx * (t - arrival), side * speed * (t - arrival), radius, vx, side * speed)],
            time=t,
        )

    ticks = drive(Controller(config()), Line(4.0, 0.5), surroundings_at, 25.0, seed=seed)
    assert min_gap_while_moving(ticks) > 0.0
    assert ticks[-1]["step"].mode is Mode.FINISHED


def test_robot_stays_inside_a_corridor():
    """A post leaves room on its narrow side only, because the corridor blocks the wide side."""
    corridor = Corridor([0.0, 4.0], [0.8, 0.8], [0.3, 0.3])
    surroundings = Surroundings([post(2.0, 0.05, 0.05)], corridor=corridor)
    controller = Controller(config())
    ticks = drive(controller, Line(4.0), at_start(surroundings), 22.0)
    assert column(ticks, "gap").min() > 0.02
    assert column(ticks, "pose")[:, 1].max() > 0.25
    assert ticks[-1]["step"].mode is Mode.FINISHED


def test_reported_clearance_equals_the_true_gap():
    ticks = post_drive(0.0)
    clearance = np.array([tick["step"].clearance for tick in ticks])
    is_finite = np.isfinite(clearance)
    assert is_finite.sum() > 50
    assert np.abs(clearance - column(ticks, "gap"))[is_finite].max() < 0.02


def test_robot_brakes_if_the_surroundings_are_old():
    controller, reference = Controller(config()), Line(4.0)
    ticks = drive(controller, reference, at_start(Surroundings(time=0.0)), 4.0)
    modes = [tick["step"].mode for tick in ticks]
    assert modes[10] is Mode.TRACKING
    assert ticks[-1]["step"].mode is Mode.STOPPED
    assert "s old; free_space.max_age is 0.5 s" in ticks[-1]["step"].message


def test_robot_brakes_if_the_surroundings_are_from_the_future():
    controller = Controller(config())
    ticks = drive(controller, Line(4.0), at_start(Surroundings(time=10.0)), 1.0)
    assert all(tick["step"].mode in (Mode.BRAKING, Mode.STOPPED) for tick in ticks[2:])
    assert "in the future" in ticks[-1]["step"].message


def test_invalid_surroundings_do_not_replace_the_previous_surroundings():
    controller = Controller(config())
    wall = Surroundings([box(2.0, 0.0, 0.4, 4.0)])
    controller.feature("free_space").set_obstacles(wall)
    with pytest.raises(SurroundingsError):
        controller.feature("free_space").set_obstacles(Surroundings([[[0.0, 0.0], [np.nan, 1.0], [1.0, 1.0]]]))
    ticks = drive(controller, Line(4.0), lambda t: wall if t < 1e-9 else None, 9.0)
    assert ticks[-1]["step"].mode is Mode.STOPPED


def test_repeated_drives_are_identical():
    surroundings = Surroundings([post(1.2, 0.02, 0.1)], discs=[MovingDisc(2.0, 1.0, 0.2, 0.0, -0.2)], time=0.0)

    def run():
        def surroundings_at(t):
            discs = [MovingDisc(2.0, 1.0 - 0.2 * t, 0.2, 0.0, -0.2)]
            return Surroundings(surroundings.polygons, discs, time=t)

        return np.array(
            [tick["step"].command for tick in drive(Controller(config()), Line(2.5), surroundings_at, 6.0, seed=4)]
        )

    assert (run() == run()).all()


def test_empty_surroundings_change_commands_only_by_rounding():
    plain = Controller(ControllerConfig())
    avoiding = Controller(config())
    avoiding.feature("free_space").set_obstacles(Surroundings())
    runs = []
    for controller in (plain, avoiding):
        robot, reference = make_plant("model:ssm", seed=1), Line(1.5)
        robot.reset([0.0, 0.0, 0.0])
        controller.start(reference, 0.0)
        commands = []
        for _ in range(200):
            commands.append(controller.step(robot.time, robot.measure()).command)
            robot.advance(commands[-1])
        runs.append(np.array(commands))
    assert np.abs(runs[0] - runs[1]).max() < 1e-6


def test_return_path_does_not_cross_a_wall():
    """A robot next to its path, behind a wall, stops with a message or drives around the wall."""
    reference = Line(4.0)
    wall = Surroundings([box(1.2, 0.42, 4.6, 0.1)])
    controller, robot = Controller(config()), make_plant("model:ssm", seed=0)
    robot.reset([0.3, 0.8, 0.0])
    controller.start(reference, 0.0)
    controller.feature("free_space").set_obstacles(wall)
    settings = controller.config.features["free_space"]
    footprint, pieces = PlacedFootprint(Footprint(settings.corners)), build_pieces(wall, settings)
    messages = set()
    for _ in range(300):
        step = controller.step(robot.time, robot.measure())
        messages.add(step.message.split(";")[0])
        robot.advance(step.command)
        (gap,), _ = min_gaps(footprint, pieces, np.array([robot.true_pose]), np.zeros(1), MAX_GAP)
        assert gap > 0.01
    assert messages & {"no way: no free path leads back to the reference"} or any(
        "rejoining" in message for message in messages
    )


CIRCLE = load_trajectory("circle")
HORIZON = 15


def test_active_half_spaces_converge_to_the_solution_of_ipopt():
    """A wall next to the circle leaves less room than the footprint needs, so the rows of half-spaces are active."""
    overrides = {"horizon": HORIZON, "reentry.enabled": False} | NO_SLIP | EXACT
    free = {"free_space.enabled": True, "free_space.uncertainty_factor": 0.0, "free_space.swerve": 0.0}
    config = load_config("ssm", overrides | free)
    pose = CIRCLE.sample([160 * config.sample_time]).pose[0]
    side = np.array([np.sin(pose[2]), -np.cos(pose[2])])
    along = np.array([side[1], -side[0]])
    centre = pose[:2] + (0.2 + free_space_of(config).margin + 0.01 + 0.3) * side + 0.1 * along
    corners = [centre + x * along + y * side for x, y in ((-0.1, -0.3), (0.3, -0.3), (0.3, 0.3), (-0.1, 0.3))]

    def make_controller():
        controller = Controller(config)
        # Disable the check of the stopping path and the path search.
        controller.feature("free_space")._keeper._sweep = lambda *_: SimpleNamespace(sample=-1, min_gap=1.0)
        controller.feature("free_space")._keeper._plan_path = lambda *_: ""
        controller.feature("free_space").set_obstacles(Surroundings([corners]))
        return controller

    tables = {}

    def record_rows(controller):
        keeper = controller.feature("free_space")._keeper
        set_rows = keeper._set_rows

        def set_and_store(t, guide):
            set_rows(t, guide)
            tables[t] = controller._tick.parameters.copy()

        keeper._set_rows = set_and_store
        return controller

    controller = record_rows(make_controller())
    drive = record(controller, IdealRobot(controller._prediction.sampled, np.zeros(3)), CIRCLE, 160, lambda *_: None)

    def keep_rows(replayed, time):
        """Use the planes of the drive, which are data of the problem."""
        table = replayed._tick.parameters
        replayed.feature("free_space")._keeper._set_rows = lambda *_: table.__setitem__(slice(None), tables[time])

    replayed, result = iterate_to_convergence(make_controller, drive, CIRCLE, keep_rows)
    plan, plan_without = (
        solve_with_ipopt(replayed),
        solve_with_ipopt(replayed, load_config(replayed.config, {"free_space.enabled": False})),
    )
    assert result.solver.soft_limits
    assert np.abs(plan - plan_without).max() > 1e-3, "the half-spaces must be active"
    assert result.planned_commands == pytest.approx(plan, abs=2e-5)
