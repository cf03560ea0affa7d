"""Path planner and the command `plan`."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commands import call, refusal
from diffdrive_mpc import ConfigError, load_trajectory
from diffdrive_mpc_extras.free_space import MovingDisc, Surroundings
from diffdrive_mpc_extras.planner import plan, plan_each
from diffdrive_mpc_extras.planner.clearance import PlanError, outline
from diffdrive_mpc_extras.planner.inputs import (
    Inputs,
    arc_arc_arc,
    arc_straight,
    arc_straight_arc,
    make_inputs,
    move_poses,
    rates_of,
    sharpest_radius,
)
from diffdrive_mpc_extras.planner.result import integrate_commands
from diffdrive_mpc_extras.planner.search import PlanSearch
from diffdrive_mpc_extras.planner.settings import load_plan_settings
from diffdrive_mpc_extras.turn_costs import (
    SlipCoefficients,
    TorqueTable,
    TurnCosts,
    load_drive_constants,
    load_turn_costs,
    load_vehicle,
    turn_costs_text,
)
from refusals import one_line_error

BOT, MOTORS = load_vehicle("fsu_bot"), load_drive_constants("fsu_bot")
SPEED = 0.4


def surface(name, radius, outer, inner, *, drive=MOTORS, slip=None):
    """Build a surface with the torques of both sides [N m] at each turning radius [m]."""
    columns = {"radius": radius, "outer": outer, "inner": inner}
    columns = {name: tuple(values.tolist()) for name, values in columns.items()}
    curve = TorqueTable(**columns, speed=SPEED, speed_exponent=0.0)
    slip = slip or SlipCoefficients()
    return TurnCosts(name=name, vehicle=BOT, drive=drive, slip=slip, curve=curve, provenance="a test")


def torque_limited(min_radius, slip=None):
    """Build a surface with the outer side at its torque limit below a radius, and lower torques in wider turns."""
    radius = np.geomspace(0.2, 500.0, 60)
    turn = np.minimum(4.6, 0.95 * 4.6 * (min_radius / radius) ** 1.2)
    return surface(f"least radius {min_radius:g} m", radius, (turn + 0.2).clip(max=4.6), 0.22 - turn, slip=slip)


def dry_friction(slip=None):
    """Build a surface with dry friction: equal torques in all turns, without regeneration and losses."""
    radius = np.geomspace(0.02, 2000.0, 80)
    turn = np.where(radius < 100.0, 2.0, 2.0 * (100.0 / radius))
    inner = np.where(radius < 0.195, -0.21, 0.21) - turn
    drive = MOTORS.model_copy(update={"resistance": 0.0, "regeneration": False})
    return surface("dry friction", radius, 0.21 + turn, inner, drive=drive, slip=slip)


def dubins(start, goal, radius):
    """Compute the length of the shortest path of bounded curvature with the six words of Shkel and Lumelsky, 2001."""
    dx, dy = (np.asarray(goal) - start)[:2] / radius
    distance, bearing = np.hypot(dx, dy), np.arctan2(dy, dx)
    wrap = lambda angle: np.mod(angle, 2 * np.pi)  # noqa: E731
    results = []
    # Words that start with a turn to the left, and their mirror images.
    for side in (1, -1):
        a, b = wrap(side * (start[2] - bearing)), wrap(side * (goal[2] - bearing))
        sa, sb, ca, cb, cab = np.sin(a), np.sin(b), np.cos(a), np.cos(b), np.cos(a - b)
        square = 2 + distance**2 - 2 * cab + 2 * distance * (sa - sb)
        if square >= 0:
            t = np.arctan2(cb - ca, distance + sa - sb)
            results.append(wrap(t - a) + np.sqrt(square) + wrap(b - t))
        square = -2 + distance**2 + 2 * cab + 2 * distance * (sa + sb)
        if square >= 0:
            p = np.sqrt(square)
            t = np.arctan2(-ca - cb, distance + sa + sb) - np.arctan2(-2.0, p)
            results.append(wrap(t - a) + p + wrap(t - b))
        cosine = (6 - distance**2 + 2 * cab - 2 * distance * (sa - sb)) / 8
        if abs(cosine) <= 1:
            p = wrap(2 * np.pi - np.arccos(cosine))
            t = wrap(np.arctan2(cb - ca, distance + sa - sb) - a + p / 2)
            results.append(t + p + wrap(b - a - t + p))
    return radius * min(results)


def dense_energy(costs, start, goal, radii):
    """Compute the minimum energy of arc-straight-arc paths over pairs of radii by an exhaustive search."""
    min_energy, best_radii = np.inf, None
    power = lambda v, w: float(costs.power([[v, w]])[0])  # noqa: E731
    straight = power(SPEED, 0.0) / SPEED
    for (r1, r2), s1, s2 in itertools.product(itertools.product(radii, radii), (1, -1), (1, -1)):
        # Without slip: centres to the left or right at the radius.
        c1 = start[:2] + s1 * r1 * np.array([-np.sin(start[2]), np.cos(start[2])])
        c2 = goal[:2] + s2 * r2 * np.array([-np.sin(goal[2]), np.cos(goal[2])])
        gap, offset = c2 - c1, s2 * r2 - s1 * r1
        distance = np.hypot(*gap)
        if distance < abs(offset):
            continue
        length = np.sqrt(distance**2 - offset**2)
        heading = np.arctan2(gap[1], gap[0]) - np.arctan2(offset, length)
        t1, t2 = np.mod(s1 * (heading - start[2]), 2 * np.pi), np.mod(s2 * (goal[2] - heading), 2 * np.pi)
        energy = straight * length
        for r, turn in ((r1, t1), (r2, t2)):
            if 1e-9 < turn < 2 * np.pi - 1e-9:
                energy += power(SPEED, SPEED / r) * turn * r / SPEED
        if energy < min_energy:
            min_energy, best_radii = energy, (r1, r2)
    return min_energy, best_radii


SETTINGS = load_plan_settings()
HALF_TRACK = 0.5 * BOT.track
SYMMETRIC = SlipCoefficients(a11=-0.004, a22=-0.001, a23=-0.006, a32=-0.35, a33=-0.02)
NO_VIA = np.zeros((0, 2))
ORIGIN = np.zeros(3)
goals = st.tuples(st.floats(-6, 6), st.floats(-6, 6), st.floats(-math.pi, math.pi)).filter(
    lambda goal: math.hypot(*goal[:2]) > 0.5
)


def search_plan(costs, goal, minimise="distance", start=ORIGIN, via=NO_VIA, **allowed):
    allowed = {"reverse": False, "spot": False} | allowed
    inputs = make_inputs(costs, minimise, SPEED, SETTINGS, **allowed)
    return PlanSearch(inputs, start, np.asarray(goal, dtype=float), via, SETTINGS.search, None).run()


def inputs_of(costs, commands, minimise="energy"):
    commands = np.asarray(commands, dtype=float)
    twists = costs.twist(commands)
    return Inputs(commands, twists, rates_of(costs, minimise, commands, twists), np.abs(twists[:, 2]) < 1e-9)


def ends_of(inputs, paths, poses):
    ends = poses[paths.start]
    for piece in range(3):
        ends = move_poses(ends, inputs.displacements(paths.inputs[:, piece], paths.times[:, piece]))
    return ends


@given(goal=goals)
@settings(max_examples=40, deadline=None)
def test_shortest_path_without_slip_is_the_dubins_path(goal):
    costs = torque_limited(1.0)
    result = search_plan(costs, goal)
    assert result.cost == pytest.approx(dubins(ORIGIN, goal, sharpest_radius(costs, SPEED, SETTINGS)), rel=1e-9)


def test_paths_of_three_pieces_end_at_the_goal():
    costs = load_turn_costs("fsu_bot-default")
    inputs = make_inputs(costs, "energy", SPEED, SETTINGS, reverse=True, spot=False)
    rng = np.random.default_rng(1)
    poses, goal = rng.uniform(-4, 4, (5, 3)), np.array([2.0, 1.0, 0.5])
    subset = inputs.select(np.array([0, 1, 2, 9, 10, 23, 24, 30, 31]))
    for paths in (arc_straight_arc(subset, poses, goal), arc_arc_arc(subset, poses, goal)):
        assert len(paths.costs) > 100
        deviation = ends_of(subset, paths, poses) - goal
        deviation[:, 2] = np.sin(0.5 * deviation[:, 2])
        assert np.abs(deviation).max() < 1e-7
    paths = arc_straight(subset, poses, goal[:2])
    assert np.abs(ends_of(subset, paths, poses)[:, :2] - goal[:2]).max() < 1e-9


@pytest.mark.parametrize("slip", [SlipCoefficients(), SYMMETRIC], ids=["no slip", "slip"])
@pytest.mark.parametrize("goal", [(3.0, 2.0, 0.3), (2.0, -3.0, 2.5), (-2.0, 2.0, -1.5)])
def test_best_commanded_radius_on_dry_friction_is_half_the_track(goal, slip):
    """The inner wheels are at rest, so the turning radius is half the slip-track (IJRR 10.1177/02783649231216499)."""
    costs = dry_friction(slip)
    radii = np.unique([*np.geomspace(0.05, 5.0, 40), HALF_TRACK])
    commands = [[SPEED, 0.0], *([SPEED, side * SPEED / radius] for radius in radii for side in (1, -1))]
    inputs = inputs_of(costs, commands)
    paths = arc_straight_arc(inputs, ORIGIN[None], np.array(goal))
    best = np.argmin(paths.costs)
    for index in paths.inputs[best, [0, 2]]:
        assert abs(inputs.commands[index, 0] / inputs.commands[index, 1]) == pytest.approx(HALF_TRACK)
    result = search_plan(costs, goal, "energy")
    assert result.cost <= paths.costs[best] * 1.0001
    arcs = [piece for piece in result.pieces if abs(piece.omega) > 0.05]
    assert arcs and all(abs(piece.radius) == pytest.approx(HALF_TRACK) for piece in arcs)


@pytest.mark.parametrize("goal", [(4.0, 2.0, 0.0), (3.0, -2.0, -1.5)])
def test_energy_agrees_with_a_dense_search(goal):
    costs = torque_limited(0.8)
    min_radius = sharpest_radius(costs, SPEED, SETTINGS)
    expected, _ = dense_energy(costs, ORIGIN, np.array(goal), np.geomspace(min_radius, 30 * min_radius, 25))
    result = search_plan(costs, goal, "energy")
    assert result.bound <= result.cost <= 1.06 * expected
    # Smooth turns with varying radius need less energy than the best pair of arcs, including the ramps.
    assert plan(costs, ORIGIN, goal).energy < expected


@given(goal=goals, minimise=st.sampled_from(["energy", "time", "distance"]))
@settings(max_examples=30, deadline=None)
def test_bound_does_not_exceed_the_remaining_cost(goal, minimise):
    costs = load_turn_costs("fsu_bot-grippy")
    inputs = make_inputs(costs, minimise, SPEED, SETTINGS, reverse=False, spot=False)
    search = PlanSearch(inputs, ORIGIN, np.array(goal), NO_VIA, SETTINGS.search, None)
    paths = arc_straight_arc(inputs, ORIGIN[None], np.array(goal))
    assert search.bound_from(ORIGIN) <= paths.costs.min() * (1 + 1e-9)


@pytest.mark.parametrize("name", ["slippery", "default", "carpet", "grippy"])
@pytest.mark.parametrize("goal", [(8.0, 5.0, 0.0), (6.0, -4.0, -1.0)])
def test_each_plan_is_feasible_and_minimises_its_objective(name, goal):
    costs = load_turn_costs(f"fsu_bot-{name}")
    plans = plan_each(costs, ORIGIN, goal)
    for objective, best in plans.items():
        for alternative in plans.values():
            assert best.amount(objective) <= alternative.amount(objective) * 1.0005
        assert best.status == "polished"
        assert integrate_commands(costs, best.commands, ORIGIN, best.sample_time)[-1] == pytest.approx(goal, abs=1e-7)
        sample = best.trajectory.sample([0.0, best.duration])
        assert sample.pose == pytest.approx(np.array([ORIGIN, goal]), abs=1e-7)
        assert best.energy == pytest.approx(costs.power(best.commands).sum() * best.sample_time)
        v, omega = best.commands.T
        rise = np.abs(np.diff(np.concatenate([[[0, 0]], best.commands, [[0, 0]]]), axis=0)) / best.sample_time
        assert v.max() <= SPEED * 1.001 and v.min() >= 0
        assert rise[:, 0].max() <= SETTINGS.motion.acceleration * 1.01
        assert rise[:, 1].max() <= SETTINGS.motion.yaw_acceleration * 1.1
        assert (v[v > 0.1] >= np.abs(omega[v > 0.1]) * costs.least_radius(SPEED)).all()


@given(x=st.floats(-50, 50), y=st.floats(-50, 50), turn=st.floats(-3, 3))
@settings(max_examples=3, deadline=None)
def test_plan_does_not_depend_on_the_frame(x, y, turn):
    costs, goal = load_turn_costs("fsu_bot-carpet"), np.array([5.0, 2.0, 0.5])
    start = np.array([x, y, turn])
    moved_plan = plan(costs, start, move_poses(start, goal))
    reference_plan = plan(costs, ORIGIN, goal)
    assert moved_plan.energy == pytest.approx(reference_plan.energy, rel=2e-3)
    assert moved_plan.poses[-1][:2] == pytest.approx(move_poses(start, goal)[:2], abs=1e-6)


def test_plan_respects_the_margin_to_obstacles():
    costs = load_turn_costs("fsu_bot-slippery")
    discs = [MovingDisc(3.0, 0.2, 0.15), MovingDisc(4.5, -0.4, 0.15)]
    box = np.array([[2.0, 0.9], [5.0, 0.9], [5.0, 1.2], [2.0, 1.2]])
    result = plan(costs, ORIGIN, (7.0, 0.0, 0.0), obstacles=Surroundings(polygons=[box], discs=discs))
    # Distances of points on the outline of the robot.
    low, high = outline(BOT).corners.min(0), outline(BOT).corners.max(0)
    side = np.linspace(0, 1, 12)[:, None]
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    ring = np.concatenate([a + side * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)])
    for pose in result.poses[::5]:
        points = move_poses(np.tile(pose, (len(ring), 1)), np.column_stack([ring, np.zeros(len(ring))]))[:, :2]
        for disc in discs:
            assert np.hypot(*(points - (disc.x, disc.y)).T).min() - disc.radius >= SETTINGS.motion.margin - 1e-3
        separation = np.maximum(np.maximum(box.min(0) - points, points - box.max(0)), 0)
        assert np.hypot(*separation.T).min() >= SETTINGS.motion.margin - 1e-3
    assert result.energy > plan(costs, ORIGIN, (7.0, 0.0, 0.0)).energy


def test_reverse_and_turns_on_the_spot_permit_shorter_plans():
    costs = load_turn_costs("fsu_bot-default")
    reverse_plan = plan(costs, ORIGIN, (-3.0, 0.0, 0.0), reverse=True)
    assert reverse_plan.commands[:, 0].max() < 1e-6 and reverse_plan.length == pytest.approx(3.0, abs=0.05)
    turn = plan(load_turn_costs("fsu_bot-slippery"), ORIGIN, (0.0, 2.0, math.pi), minimise="distance", on_the_spot=True)
    assert turn.length < 3.0 and turn.poses[-1] == pytest.approx([0.0, 2.0, math.pi], abs=1e-6)


def test_unfinished_polish_is_reported_and_the_plan_ends_at_the_goal():
    limited_settings = SETTINGS.model_copy(update={"polish": SETTINGS.polish.model_copy(update={"iterations": 1})})
    result = plan(load_turn_costs("fsu_bot-grippy"), ORIGIN, (6.0, 3.0, 0.5), settings=limited_settings)
    assert result.status in ("unfinished", "search") and "Maximum_Iterations_Exceeded" in result.solver
    assert result.poses[-1] == pytest.approx([6.0, 3.0, 0.5], abs=1e-6)


BOX = np.array([[4.0, -1.0], [6.0, -1.0], [6.0, 1.0], [4.0, 1.0]])
RING = [
    np.array([[3, -2], [7, -2], [7, -1.8], [3, -1.8]]),
    np.array([[3, 1.8], [7, 1.8], [7, 2], [3, 2]]),
    np.array([[3, -2], [3.2, -2], [3.2, 2], [3, 2]]),
    np.array([[6.8, -2], [7, -2], [7, 2], [6.8, 2]]),
]


@pytest.mark.parametrize(
    ("goal", "changes", "message"),
    [
        ((0.0, 0.0, 2 * math.pi), {}, "start and goal are the same"),
        ((1.0, math.nan, 0.0), {}, "finite numbers"),
        ((1.0, 0.0), {}, "give x, y"),
        ((5.0, 0.0, 0.0), {"speed": 3.0}, "exceeds 1 m/s"),
        ((5.0, 0.0, 0.0), {"obstacles": Surroundings(polygons=[BOX])}, "overlaps an obstacle"),
        ((5.0, 0.0, 0.0), {"obstacles": Surroundings(polygons=RING)}, "obstacles block all paths"),
        ((8.0, 0.0, 0.0), {"via": [(5.0, 0.0)], "obstacles": Surroundings(polygons=[BOX])}, "via 1"),
        ((0.0, 1.0, 0.0), {}, r"minimum radius of .* m for 1.00 m of distance; allow driving backward"),
    ],
)
def test_infeasible_plan_raises_plan_error(goal, changes, message):
    assert issubclass(PlanError, ConfigError)
    with one_line_error(PlanError, match=message):
        plan(load_turn_costs("fsu_bot-default"), ORIGIN, goal, **changes)


@pytest.fixture(scope="module")
def plan_folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("plan")
    costs = out / "mine.yaml"
    costs.write_text(turn_costs_text(load_turn_costs("fsu_bot-grippy")), encoding="utf-8")
    call("plan", "--costs", costs, "--from", "1,-1,90", "--to", "-4,6,180", "--via", "0,3", "--out", out / "a")
    return out / "a"


def test_written_trajectory_connects_start_and_goal(plan_folder):
    path = load_trajectory(plan_folder / "trajectory.csv")
    start, end = path.sample([0.0, path.duration]).pose
    assert start == pytest.approx([1.0, -1.0, math.pi / 2], abs=1e-6)
    assert end[:2] == pytest.approx([-4.0, 6.0], abs=1e-6)
    assert math.cos(end[2]) == pytest.approx(-1.0)
    poses = path.sample(np.linspace(0, path.duration, 2000)).pose
    assert np.hypot(*(poses[:, :2] - [0.0, 3.0]).T).min() < 0.02


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--from", "0,0,0", "--to", "5,nan,0"), "give X,Y,DEG, 3 numbers"),
        (("--from", "0,0,0", "--to", "5,0,0", "--costs", "fsu_bot-defualt"), "did you mean 'fsu_bot-default'"),
    ],
)
def test_invalid_argument_is_refused_without_output(tmp_path, arguments, message):
    assert message in refusal("plan", *arguments, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()
