"""Worlds: contacts, visibility, costmap, person tracking and random worlds."""

import itertools
import math
import re
from pathlib import Path

import numpy as np
import pytest
from loop_parts import ConstantTwist, FeedForward, FixedStep
from scipy import ndimage
from typer.testing import CliRunner

from diffdrive_mpc import ConfigError
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.sim import make_plant, simulate
from diffdrive_mpc_extras.worlds.drawn_world import drawn_world, drawn_world_settings
from diffdrive_mpc_extras.worlds.passage import outline_points
from diffdrive_mpc_extras.worlds.plug_in import passage
from diffdrive_mpc_extras.worlds.shapes import Box, Mover, Polygon, Shapes, Wall, distance_to_polygon
from diffdrive_mpc_extras.worlds.sight import FREE, OCCUPIED, UNKNOWN, ObstacleSensors, cast_rays, in_view
from diffdrive_mpc_extras.worlds.world import World, load_world
from diffdrive_mpc_extras.worlds.world_plant import ContactError, WorldPlant
from refusals import one_line_error

WIDTH, LENGTH = 0.38, 0.30
"""Width over the tyres and length of the body of the robot of the papers [m]."""


def write_world(folder: Path, text: str) -> Path:
    path = folder / "test_world.yaml"
    path.write_text(f"description: test world\ntime_limit: 20\n{text}", encoding="utf-8")
    return path


def plant_in(folder: Path, text: str) -> WorldPlant:
    return make_plant(f"world:{write_world(folder, text)}", sensors="perfect")


def drive(plant: WorldPlant, command: tuple[float, float], ticks: int) -> FloatArray:
    plant.reset((0, 0, 0))
    poses = []
    for _ in range(ticks):
        poses.append(plant.true_pose)
        plant.advance(command)
    return np.array(poses)


def test_contact_with_a_wall_has_its_position_and_the_speed_of_the_robot(tmp_path: Path) -> None:
    plant = plant_in(tmp_path, "ends_at_contact: false\nwalls: [{start: [1, -1], end: [1, 1], thickness: 0.1}]\n")
    poses = drive(plant, (0.5, 0.0), 200)
    (contact,) = plant.contacts
    assert contact.obstacle == "wall 0"
    assert contact.x == pytest.approx(0.95, abs=0.01)
    assert contact.speed == pytest.approx(0.5, abs=0.03)
    # The front of the body stops at the wall, and the wall does not move.
    assert poses[-1, 0] == pytest.approx(0.95 - LENGTH / 2, abs=0.01)


def test_drive_along_a_wall_has_contacts_only_if_the_tyres_overlap_it(tmp_path: Path) -> None:
    for gap, has_contact in ((0.01, False), (-0.01, True)):
        centre = WIDTH / 2 + gap + 0.05
        wall = f"{{start: [0.5, {centre}], end: [3, {centre}], thickness: 0.1}}"
        text = f"ends_at_contact: false\nwalls: [{wall}]\n"
        plant = plant_in(tmp_path, text)
        drive(plant, (0.5, 0.0), 150)
        assert bool(plant.contacts) == has_contact


def test_contact_ends_the_run_and_its_message_names_the_obstacle(tmp_path: Path) -> None:
    plant = plant_in(tmp_path, "posts: [{at: [0.6, 0.1], radius: 0.1}]\n")
    with pytest.raises(ContactError, match=r"the robot touched post 0 at x = 0\.5\d m, y = 0\.\d\d m with 0\.\d\d m/s"):
        drive(plant, (0.5, 0.0), 200)
    run = simulate(FeedForward(), plant, ConstantTwist(0.5, 0.0, 3.0))
    assert "post 0" in run.ended
    assert passage(run).contacts == 1 and not passage(run).arrived
    assert passage(run).clearance_m == 0.0


def test_distant_obstacles_do_not_change_a_run(tmp_path: Path) -> None:
    distant = "posts: [{at: [50, 50], radius: 1}]\nboxes: [{centre: [60, 0], size: [1, 2]}]\nmovers: [{x: 70, y: 0}]\n"
    poses = drive(plant_in(tmp_path, distant), (0.6, 0.5), 100)
    plain_plant = make_plant("mujoco", sensors="perfect")
    plain_plant.reset((0, 0, 0))
    for pose in poses:
        np.testing.assert_array_equal(plain_plant.true_pose, pose)
        plain_plant.advance((0.6, 0.5))


def test_equal_seeds_give_equal_runs_and_observations(tmp_path: Path) -> None:
    contents, poses = [], []
    for _ in range(2):
        plant = make_plant("world:crossing", seed=4)
        plant.reset((0, 0, 0))
        observations = []
        for _ in range(60):
            observations.append(plant.look())
            plant.advance((0.3, 0.1))
        contents.append([(view.time, view.discs, view.grid.cells.tobytes()) for view in observations if view])
        poses.append(plant.true_pose)
    assert contents[0] == contents[1] and len(contents[0]) == 12
    np.testing.assert_array_equal(*poses)


def test_walker_hitting_a_standing_robot_neither_pushes_it_nor_ends_the_run(tmp_path: Path) -> None:
    plant = plant_in(tmp_path, "movers: [{x: 0, y: 0, time: 2, direction: 1.57, speed: 1.0}]\n")
    poses = drive(plant, (0.0, 0.0), 200)
    (contact,) = plant.contacts
    assert contact.obstacle == "mover 0"
    # The mover is at the centre at 2 s; the contact starts and ends at a distance of half the width plus the radius.
    assert contact.time == pytest.approx(2.0 - (WIDTH / 2 + 0.25), abs=0.02)
    assert contact.until == pytest.approx(2.0 + (WIDTH / 2 + 0.25), abs=0.02)
    assert contact.max_speed < 0.005
    assert np.abs(poses[-1]).max() < 1e-3


def test_obstacle_behind_a_wall_is_not_visible(tmp_path: Path) -> None:
    wall, sight = Wall(start=(1.0, -0.5), end=(1.0, 0.5)), load_world("slalom").sight
    shapes = Shapes((wall.corners,), np.array([[2.0, 0.0, 0.2], [2.0, 1.9, 0.2]]))
    distances, bearings = cast_rays(np.zeros(3), shapes, sight)
    ahead = np.abs(bearings) < 0.4
    np.testing.assert_allclose(distances[ahead] * np.cos(bearings[ahead]), 0.95, atol=1e-9)
    # The second post is outside the shadow of the wall, so rays end on this post.
    to_post = np.hypot(*(distances[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)]) - [2.0, 1.9]).T)
    assert np.isclose(to_post, 0.2).sum() > 5
    hidden, visible = Mover(x=2.0, y=0.0), Mover(x=2.0, y=1.9)
    assert not in_view(hidden, 0.0, np.zeros(3), shapes, sight)
    assert in_view(visible, 0.0, np.zeros(3), Shapes((wall.corners,), np.zeros((0, 3))), sight)
    # A mover behind the robot is outside the field of view of 270 degrees.
    assert not in_view(Mover(x=-2.0, y=0.0), 0.0, np.zeros(3), shapes, sight)
    assert in_view(Mover(x=-2.0, y=0.0), 0.0, np.array([0.0, 0.0, math.pi]), shapes, sight)
    assert not in_view(Mover(x=2.0, y=1.9, seen_from=1.0), 0.5, np.zeros(3), Shapes((), np.zeros((0, 3))), sight)


def test_costmap_is_unknown_behind_obstacles_and_outside_the_field_of_view(tmp_path: Path) -> None:
    walls = "walls: [{start: [1, -3], end: [1, 3], thickness: 0.1}]\n"
    content = walls + "posts: [{at: [1.6, 0], radius: 0.1}]\nsight: {range_sd: 0, latency: 0}\n"
    grid = ObstacleSensors(load_world(write_world(tmp_path, content)), 0).observe(0.0, [0, 0, 0]).grid

    def cell(x: float, y: float) -> int:
        return int(grid.cells[math.floor((y - grid.origin[1]) / 0.05), math.floor((x - grid.origin[0]) / 0.05)])

    assert cell(0.5, 0.0) == FREE and cell(0.96, 0.0) == OCCUPIED
    assert cell(1.3, 0.0) == cell(1.6, 0.0) == UNKNOWN  # behind the wall
    assert cell(-1.5, 0.0) == UNKNOWN  # behind the robot
    assert set(np.unique(grid.cells)) == {UNKNOWN, FREE, OCCUPIED}


def test_observations_arrive_with_their_period_and_latency(tmp_path: Path) -> None:
    text = "sight: {period: 0.1, latency: 0.06, kind: shapes}\n"
    sensors = ObstacleSensors(load_world(write_world(tmp_path, text)), 0)
    times = [k / 50 for k in range(50)]
    arrivals = [(now, new.time) for now in times if (new := sensors.observe(now, [0, 0, 0])) is not None]
    assert len(arrivals) == 10
    for now, stamp in arrivals:
        assert 0.06 - 1e-9 <= now - stamp <= 0.08 + 1e-9


def test_person_track_has_the_true_velocity_and_the_configured_noise(tmp_path: Path) -> None:
    sight = "sight: {person_sd: 0.03, latency: 0, kind: shapes, range: 9}\n"
    text = "movers: [{x: 2, y: -2, direction: 1.57, speed: 1.0}]\n" + sight
    world = load_world(write_world(tmp_path, text))
    errors = []
    for seed in range(60):
        sensors = ObstacleSensors(world, seed)
        observations = [sensors.observe(k / 10, [0, 0, 0]) for k in range(16)]
        first, last = observations[0].discs[0], observations[-1].discs[0]
        errors.append([first.x - 2.0, first.y + 2.0, last.vx, last.vy - 1.0])
        assert first.vx == first.vy == 0.0  # a single position does not determine the velocity
    errors = np.array(errors)
    assert np.abs(errors[:, :2].mean(axis=0)).max() < 4 * 0.03 / math.sqrt(60)
    assert 0.02 < errors[:, :2].std() < 0.04
    assert np.abs(errors[:, 2:].mean(axis=0)).max() < 0.06 and errors[:, 2:].std() < 0.2


@pytest.mark.parametrize("is_path_blocked", [False, True])
def test_drawn_worlds_are_passable_and_reproducible(is_path_blocked: bool) -> None:
    settings, densities = drawn_world_settings(), []
    for seed in range(6):
        world = drawn_world(seed, through=is_path_blocked)
        drawn_world.cache_clear()
        assert drawn_world(seed, through=is_path_blocked) == world
        densities.append(len(world.posts))
        assert is_passable(world, settings.disc_radius)
        clearance = world.shapes(0.0).distance(dense_path(np.array(world.way.waypoints))).min()
        if is_path_blocked:
            # A post on the path blocks the robot's hull.
            assert clearance < WIDTH / 2
        else:
            assert clearance > settings.disc_radius - 0.02
    assert len(set(densities)) > 3


def dense_path(waypoints: FloatArray) -> FloatArray:
    return np.vstack([a + np.linspace(0, 1, 30)[:, None] * (b - a) for a, b in itertools.pairwise(waypoints)])


def is_passable(world: World, radius: float) -> bool:
    """Return True if free cells connect start and goal for a disc; independent of A* and of the planner's grid."""
    x, y = np.arange(-0.4, 8.4, 0.04), np.arange(-2.6, 2.6, 0.04)
    points = np.column_stack([axis.ravel() for axis in np.meshgrid(x, y)])
    free = world.shapes(0.0).distance(points) > radius
    regions, _ = ndimage.label(free.reshape(len(y), len(x)))
    start, goal = (
        regions[np.abs(y - point[1]).argmin(), np.abs(x - point[0]).argmin()]
        for point in ((0.0, 0.0), world.way.waypoints[-1])
    )
    return bool(start == goal != 0)


def test_distances_and_corners_of_shapes() -> None:
    box = Box(centre=(1.0, 2.0), size=(2.0, 1.0), angle=math.pi / 2)
    np.testing.assert_allclose(sorted(box.corners.tolist()), [[0.5, 1], [0.5, 3], [1.5, 1], [1.5, 3]], atol=1e-12)
    points = np.array([[1.0, 2.0], [2.5, 2.0], [2.5, 4.0]])
    np.testing.assert_allclose(distance_to_polygon(points, box.corners), [0.0, 1.0, math.sqrt(2)], atol=1e-12)
    clockwise = Polygon(points=((0, 0), (0, 1), (1, 0)))
    np.testing.assert_allclose(distance_to_polygon(np.array([[0.2, 0.2], [-1, 0]]), clockwise.corners), [0, 1])
    corners = np.abs(outline_points((LENGTH, WIDTH))).max(axis=0)
    np.testing.assert_allclose(corners, [LENGTH / 2, WIDTH / 2])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("posts: [{at: [0, 0], radius: -1}]\n", r"posts\.0\.radius"),
        ("polygons: [{points: [[0, 0], [2, 0], [0.5, 0.5], [0, 2]]}]\n", r"the polygon is not convex"),
        ("posts: [{at: [.nan, 0], radius: 1}]\n", r"posts\.0\.at\.0"),
    ],
)
def test_invalid_world_file_raises_config_error(tmp_path: Path, text: str, message: str) -> None:
    with one_line_error(ConfigError, match=message):
        load_world(write_world(tmp_path, text))


@pytest.mark.parametrize("name", ["doorwy", "drawn:x", "drawn:-1", "drawn:3:over", "drawn"])
def test_unknown_world_raises_config_error(name: str) -> None:
    with pytest.raises(ConfigError, match=r"drawn:SEED"):
        load_world(name)


def test_plant_without_a_body_cannot_be_in_a_world() -> None:
    with pytest.raises(ConfigError, match="use 'mujoco'"):
        make_plant("world:doorway@model:sm")


def test_arrival_at_the_goal_ends_the_run(tmp_path: Path) -> None:
    plant = plant_in(tmp_path, "way: {waypoints: [[0, 0], [1, 0]], speed: 0.5}\n")
    run = simulate(FeedForward(), plant, ConstantTwist(0.5, 0.0, 2.0))
    assert passage(run).arrived
    # The robot drives 1 m in 2 s, long before the time limit of 20 s.
    assert 2.0 <= passage(run).time_s < 2.5 and run.time[-1] < 3.0
    assert passage(run).clearance_m == math.inf


class StandingController(FeedForward):
    """Controller that never moves the robot."""

    def step(self, t: float, measurement: Measurement) -> FixedStep:
        return FixedStep(np.zeros(2))


def test_long_standstill_ends_the_run_in_a_static_world_only(tmp_path: Path) -> None:
    static, moving = "posts: [{at: [5, 5], radius: 1}]\n", "movers: [{x: 5, y: 5}]\n"
    runs = [
        simulate(StandingController(), plant_in(tmp_path, text), ConstantTwist(0.5, 0.0, 2.0))
        for text in (static, moving)
    ]
    assert [round(run.time[-1]) for run in runs] == [10, 20]  # give_up, and the time limit of the file
    for run in runs:
        assert not passage(run).arrived and passage(run).contacts == 0


def test_simulate_prints_the_result_of_the_passage_and_its_table() -> None:
    arguments = ["simulate", "--plant", "world:slalom", "--controller", "rpp+stop"]
    line = r"^world: (not )?arrived, \d+ contacts, minimum clearance \d\.\d+ m$"
    assert re.search(line, CliRunner().invoke(app, arguments).stdout, re.MULTILINE)
    detailed = CliRunner().invoke(app, [*arguments, "--details"]).stdout
    assert "world:slalom" in detailed and "walked" in detailed
