"""Gaps, planes and pieces of free space, compared with simple reference geometry."""

import numpy as np
import pytest
from identification_parts import differences

from diffdrive_mpc.mpc.trajectories import load_trajectory
from diffdrive_mpc_extras.free_space import (
    Corridor,
    Footprint,
    MovingDisc,
    OccupancyGrid,
    Surroundings,
    SurroundingsError,
)
from diffdrive_mpc_extras.free_space.config import FreeSpace
from diffdrive_mpc_extras.free_space.pieces import (
    PlacedFootprint,
    address,
    build_pieces,
    half_space_c_function,
    half_space_function,
    load_free_space,
    min_gaps,
    rectangles,
)
from diffdrive_mpc_extras.free_space.polygons import area, convex_pieces, crosses_itself, hull
from refusals import one_line_error

CONFIG = FreeSpace()


def gap_to(footprint, pieces, piece, pose, time=0.0):
    """Compute the signed distance to one piece [m], and the direction (2,) of the gap, from the footprint."""
    pose, normal = np.array(pose, dtype=float), np.empty(2)
    normal_address = address(normal, "real *")
    gap = load_free_space()[1].ddmpc_gap(footprint.struct, pieces.struct, piece, address(pose), time, normal_address)
    return gap, normal


def transform(corners, pose):
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    return corners @ np.array([[cosine, sine], [-sine, cosine]]) + pose[:2]


def segment_distance(point, a, b):
    along = b - a
    fraction = np.clip((point - a) @ along / max(along @ along, 1e-300), 0.0, 1.0)
    return np.hypot(*(point - a - fraction * along))


def edge_distance(first, second):
    """Compute the minimum distance between the edges of two polygons."""
    pairs = ((first, second), (second, first))
    return min(segment_distance(p, b[i - 1], b[i]) for a, b in pairs for p in a for i in range(len(b)))


def max_gap(first, second, directions=7200):
    """Compute the maximum gap over many directions, which is the signed distance of convex sets."""
    angle = np.linspace(0.0, 2.0 * np.pi, directions, endpoint=False)
    a = np.stack([np.cos(angle), np.sin(angle)])
    return float(((second @ a).min(axis=0) - (first @ a).max(axis=0)).max())


def random_hull(rng, count, spread):
    return hull(rng.normal(scale=spread, size=(count, 2)))


@pytest.mark.parametrize("seed", range(40))
def test_gap_is_the_distance_of_two_polygons_or_their_penetration_depth(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(scale=0.3, size=(int(rng.integers(1, 7)), 2))
    robot = Footprint.rectangle(0.5, 0.4) if seed % 4 else Footprint(points, 0.2)
    obstacle = random_hull(rng, 9, 0.5)
    pose = np.array([*rng.uniform(-2.0, 2.0, 2), rng.uniform(-4.0, 4.0)])
    pieces = build_pieces(Surroundings([obstacle]), CONFIG)
    gap, normal = gap_to(PlacedFootprint(robot), pieces, 0, pose)
    corners = transform(robot.corners, pose)
    assert np.hypot(*normal) == pytest.approx(1.0)
    along = (obstacle @ normal).min() - (corners @ normal).max() - robot.radius
    assert along == pytest.approx(gap, abs=1e-12)  # gap in the returned direction
    if gap + robot.radius > 0.0:
        assert gap == pytest.approx(edge_distance(corners, obstacle) - robot.radius, abs=1e-12)
    assert gap == pytest.approx(max_gap(corners, obstacle) - robot.radius, abs=2e-3)


@pytest.mark.parametrize("seed", range(5))
def test_footprint_on_the_free_side_of_a_plane_does_not_touch_the_piece(seed):
    rng = np.random.default_rng(100 + seed)
    robot, obstacle = PlacedFootprint(Footprint.rectangle(0.5, 0.4)), random_hull(rng, 7, 0.4)
    pieces, pose = build_pieces(Surroundings([obstacle]), CONFIG), np.array([*rng.uniform(-1.5, 1.5, 2), 0.3])
    gap, normal = gap_to(robot, pieces, 0, pose)
    plane = (obstacle @ normal).min()
    placements = pose + rng.uniform(-0.5, 0.5, (200, 3))
    for placement in placements:
        protrusion = (transform(robot.footprint.corners, placement) @ normal).max() - plane
        if protrusion <= 0.0:
            assert gap_to(robot, pieces, 0, placement)[0] >= min(-protrusion, 0.0) - 1e-12
    assert gap > 0.0 or (transform(robot.footprint.corners, pose) @ normal).max() >= plane


def test_moving_disc_is_at_its_predicted_position():
    surroundings = Surroundings(discs=[MovingDisc(2.0, 1.0, 0.3, -1.0, -0.5)], time=5.0)
    robot = PlacedFootprint(Footprint(((0.0, 0.0),), 0.2))
    gap, normal = gap_to(robot, build_pieces(surroundings, CONFIG), 0, (0.0, 0.0, 0.7), time=1.0)
    assert gap == pytest.approx(np.hypot(1.0, 0.5) - 0.5)
    assert normal == pytest.approx(np.array([1.0, 0.5]) / np.hypot(1.0, 0.5))


@pytest.mark.parametrize("seed", range(20))
def test_convex_pieces_tile_a_polygon(seed):
    rng = np.random.default_rng(seed)
    corners = int(rng.integers(5, 12))
    angle = (np.arange(corners) + rng.uniform(0.0, 0.9, corners)) * 2.0 * np.pi / corners
    star = np.stack([np.cos(angle), np.sin(angle)], axis=1) * rng.uniform(0.3, 2.0, len(angle))[:, None]
    polygon = star if seed % 2 else star[::-1]
    assert not crosses_itself(polygon)
    pieces = convex_pieces(polygon)
    assert sum(area(piece) for piece in pieces) == pytest.approx(abs(area(polygon)))
    for piece in pieces:
        assert area(piece) >= 0.0
        assert len(hull(piece)) == len(piece)


@pytest.mark.parametrize("fraction", [0.05, 0.5, 0.95])
def test_rectangles_tile_the_occupied_cells(fraction):
    occupied = np.random.default_rng(3).random((40, 30)) < fraction
    coverage = np.zeros(occupied.shape, dtype=int)
    for row, column, row_end, column_end in rectangles(occupied).tolist():
        coverage[row:row_end, column:column_end] += 1
    assert (coverage == occupied).all()


def test_wall_of_cells_becomes_one_rectangle_at_its_position():
    cells = np.zeros((50, 80), dtype=np.int8)
    cells[10:40, 20:22] = 100
    grid = OccupancyGrid(cells, 0.05, (1.0, -2.0, np.pi / 2))
    pieces = build_pieces(Surroundings(grid=grid), CONFIG)
    assert len(pieces) == 1
    # The x axis of the grid is along the y axis of the poses.
    low, high = pieces.corners[0].min(axis=0), pieces.corners[0].max(axis=0)
    assert low == pytest.approx([1.0 - 2.0, -2.0 + 1.0])
    assert high == pytest.approx([1.0 - 0.5, -2.0 + 1.1])


def test_unknown_cells_and_the_area_outside_the_grid_can_be_occupied():
    grid = OccupancyGrid(np.full((10, 10), -1, dtype=np.int8), 0.1)
    assert len(build_pieces(Surroundings(grid=grid), CONFIG)) == 0
    pieces = build_pieces(Surroundings(grid=grid), CONFIG.model_copy(update={"unknown_is_free": False}))
    robot = PlacedFootprint(Footprint.rectangle(0.2, 0.2))
    for position in ((0.5, 0.5), (5.0, 0.5), (-1.0, -1.0), (0.5, 1.5)):
        assert min(gap_to(robot, pieces, i, (*position, 0.0))[0] for i in range(len(pieces))) < 0.0


def test_corridor_walls_have_the_given_distance_from_the_reference():
    reference = load_trajectory("circle")
    length = float(reference.sample([reference.duration]).arc_length[0])
    corridor = Corridor([0.0, length], [0.4, 0.4], [0.6, 0.6])
    pieces = build_pieces(Surroundings(corridor=corridor), CONFIG, reference)
    robot = PlacedFootprint(Footprint(((0.0, 0.0),), 0.1))
    for time in np.linspace(0.5, reference.duration - 0.5, 7):
        pose = reference.sample([time]).pose[0]
        gaps = [gap_to(robot, pieces, i, pose)[0] for i in range(len(pieces))]
        assert min(gaps) == pytest.approx(0.3, abs=0.01)


SQUARE = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
INVALID = {
    "value that is not finite": Surroundings([[[0, 0], [1, np.nan], [1, 1]]]),
    "no area": Surroundings([[[0, 0], [1, 1], [2, 2]]]),
    "cross each other": Surroundings([[SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]]]),
    "lengths are in m": Surroundings([[[0, 0], [1e9, 0], [0, 1e9]]]),
    "its position has no time": Surroundings(discs=[MovingDisc(0, 0, 0.2, 1.0, 0.0)]),
    "velocity or radius": Surroundings(discs=[MovingDisc(0, 0, 0.2, np.nan)], time=0.0),
    "faster than": Surroundings(discs=[MovingDisc(0, 0, 0.2, 1e3)], time=0.0),
    "the limit of 250,000": Surroundings(grid=OccupancyGrid(np.zeros((1000, 1000), dtype=np.int8), 0.05)),
    "resolution nan": Surroundings(grid=OccupancyGrid(np.zeros((10, 10), dtype=np.int8), np.nan)),
    "cells from 0 to 120": Surroundings(grid=OccupancyGrid(np.full((2, 2), [0, 120], dtype=np.int16), 0.05)),
    "its origin": Surroundings(grid=OccupancyGrid(np.zeros((2, 2), dtype=np.int8), 0.05, (0.0, np.inf, 0.0))),
    "rectangles": Surroundings(
        grid=OccupancyGrid((np.indices((200, 200)).sum(axis=0) % 2 * 100).astype(np.int8), 0.05)
    ),
    "does not increase": Surroundings(corridor=Corridor([0.0, 0.0], [1.0, 1.0], [1.0, 1.0])),
    "negative": Surroundings(corridor=Corridor([0.0, 1.0], [1.0, -1.0], [1.0, 1.0])),
    "time is nan": Surroundings([SQUARE], time=np.nan),
}


@pytest.mark.parametrize("message", list(INVALID))
def test_invalid_surroundings_raise_a_one_line_error(message):
    with one_line_error(SurroundingsError, message):
        build_pieces(INVALID[message], CONFIG, load_trajectory("circle"))


@pytest.mark.parametrize(
    "footprint", ["[[0, 0]]", "[[0, 0], [1, 1]]", "[[0]]", "x", "[" * 1500, "[[0, NaN], [1, 0], [1, 1]]"]
)
def test_invalid_footprint_is_rejected(footprint):
    with pytest.raises(ValueError, match="footprint"):
        FreeSpace(footprint=footprint)


def test_half_space_gradient_equals_finite_differences():
    rng = np.random.default_rng(1)
    function, symbolic = half_space_c_function(), half_space_function()
    for _ in range(20):
        pose, parameters = rng.normal(size=3), rng.normal(size=5)
        value, gradient = function(pose, np.zeros(2), np.zeros(2), np.zeros(4), parameters)
        assert float(value) == pytest.approx(float(symbolic(pose, parameters)))
        slopes = differences(lambda x, fixed=parameters: symbolic(x, fixed), pose)
        assert gradient.full()[:1, :3] == pytest.approx(slopes, abs=1e-8)


@pytest.mark.parametrize("seed", range(10))
def test_planes_contain_a_free_pose_and_separate_it_from_near_obstacles(seed):
    """A free pose satisfies all half-spaces; with enough rows each near obstacle is behind a plane."""
    rng = np.random.default_rng(seed)
    polygons = [random_hull(rng, 6, 0.2) + rng.uniform(-1.5, 1.5, 2) for _ in range(8)]
    pieces, robot = build_pieces(Surroundings(polygons), CONFIG), PlacedFootprint(Footprint.rectangle(0.5, 0.4))
    poses = np.column_stack([rng.uniform(-1.5, 1.5, (40, 2)), rng.uniform(-3.0, 3.0, 40)])
    gaps, _ = min_gaps(robot, pieces, poses, np.zeros(40), 5.0)
    poses = np.ascontiguousarray(poses[gaps > 0.01])
    count, rows = len(poses), 16
    ffi, lib = load_free_space()
    keeping = ffi.new("ddmpc_keeping *", {"margin": 0.0, "factor": 0.0, "doubt": 0.0, "reach": 0.4, "scale": 1.0})
    table, owner = np.zeros((count, rows * 5)), np.zeros((count, rows), dtype=np.intc)
    pointer, numbers = address(poses), (address(np.zeros(count)), address(np.zeros((count, 9))))
    out = address(table, "real *"), address(owner, "int *")
    lib.ddmpc_half_spaces(
        robot.struct, pieces.struct, keeping, count, pointer, pointer, pointer, *numbers, rows, rows * 5, *out
    )
    for pose, planes, owners in zip(poses, table.reshape(count, rows, 5), owner, strict=True):
        corners = transform(robot.footprint.corners, pose)
        active_planes = planes[owners >= 0]
        for a_x, a_y, d_x, d_y, b in active_planes:
            point = transform(np.array([[d_x, d_y]]), pose)[0]
            assert point @ [a_x, a_y] <= b + 1e-9
            assert (corners @ [a_x, a_y]).max() <= b + 1e-9
        for polygon in polygons:
            if edge_distance(corners, polygon) < 0.39:
                is_separated = [(polygon @ plane[:2]).min() >= plane[4] - 1e-5 for plane in active_planes]
                assert any(is_separated)
