"""Gaps, planes and pieces of free space, held against slow and plain geometry."""

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
    half_space_formula,
    half_space_function,
    least_gaps,
    load_free_space,
    pieces_of,
    rectangles,
)
from diffdrive_mpc_extras.free_space.polygons import area, convex_pieces, crosses_itself, hull
from refusals import one_line_error

CONFIG = FreeSpace()


def gap_to(footprint, pieces, piece, pose, time=0.0):
    """Compute the signed distance to one piece [m], and the direction (2,) of the gap, from the footprint."""
    pose, normal = np.array(pose, dtype=float), np.empty(2)
    to = address(normal, "real *")
    gap = load_free_space()[1].ddmpc_gap(footprint.struct, pieces.struct, piece, address(pose), time, to)
    return gap, normal


def placed(corners, pose):
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    return corners @ np.array([[cosine, sine], [-sine, cosine]]) + pose[:2]


def to_segment(point, a, b):
    along = b - a
    share = np.clip((point - a) @ along / max(along @ along, 1e-300), 0.0, 1.0)
    return np.hypot(*(point - a - share * along))


def edge_distance(first, second):
    """Compute the least distance between the edges of two polygons."""
    both = ((first, second), (second, first))
    return min(to_segment(p, b[i - 1], b[i]) for a, b in both for p in a for i in range(len(b)))


def widest_gap(first, second, directions=7200):
    """Compute the largest gap over many directions: the signed distance of convex sets."""
    angle = np.linspace(0.0, 2.0 * np.pi, directions, endpoint=False)
    a = np.stack([np.cos(angle), np.sin(angle)])
    return float(((second @ a).min(axis=0) - (first @ a).max(axis=0)).max())


def random_hull(rng, count, spread):
    return hull(rng.normal(scale=spread, size=(count, 2)))


@pytest.mark.parametrize("seed", range(40))
def test_a_gap_is_the_distance_of_two_polygons_and_the_depth_where_they_overlap(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(scale=0.3, size=(int(rng.integers(1, 7)), 2))
    robot = Footprint.rectangle(0.5, 0.4) if seed % 4 else Footprint(points, 0.2)
    obstacle = random_hull(rng, 9, 0.5)
    pose = np.array([*rng.uniform(-2.0, 2.0, 2), rng.uniform(-4.0, 4.0)])
    pieces = pieces_of(Surroundings([obstacle]), CONFIG)
    gap, normal = gap_to(PlacedFootprint(robot), pieces, 0, pose)
    corners = placed(robot.corners, pose)
    assert np.hypot(*normal) == pytest.approx(1.0)
    along = (obstacle @ normal).min() - (corners @ normal).max() - robot.radius
    assert along == pytest.approx(gap, abs=1e-12)  # it is the gap in the direction that it names
    if gap + robot.radius > 0.0:
        assert gap == pytest.approx(edge_distance(corners, obstacle) - robot.radius, abs=1e-12)
    assert gap == pytest.approx(widest_gap(corners, obstacle) - robot.radius, abs=2e-3)


@pytest.mark.parametrize("seed", range(5))
def test_no_plane_lets_a_footprint_on_its_side_touch_the_piece(seed):
    rng = np.random.default_rng(100 + seed)
    robot, obstacle = PlacedFootprint(Footprint.rectangle(0.5, 0.4)), random_hull(rng, 7, 0.4)
    pieces, pose = pieces_of(Surroundings([obstacle]), CONFIG), np.array([*rng.uniform(-1.5, 1.5, 2), 0.3])
    gap, normal = gap_to(robot, pieces, 0, pose)
    plane = (obstacle @ normal).min()
    others = pose + rng.uniform(-0.5, 0.5, (200, 3))
    for placement in others:
        beyond = (placed(robot.footprint.corners, placement) @ normal).max() - plane
        if beyond <= 0.0:
            assert gap_to(robot, pieces, 0, placement)[0] >= min(-beyond, 0.0) - 1e-12
    assert gap > 0.0 or (placed(robot.footprint.corners, pose) @ normal).max() >= plane


def test_a_moving_disc_is_where_it_will_be():
    around = Surroundings(discs=[MovingDisc(2.0, 1.0, 0.3, -1.0, -0.5)], time=5.0)
    robot = PlacedFootprint(Footprint(((0.0, 0.0),), 0.2))
    gap, normal = gap_to(robot, pieces_of(around, CONFIG), 0, (0.0, 0.0, 0.7), time=1.0)
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


@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
def test_rectangles_tile_the_occupied_cells(share):
    occupied = np.random.default_rng(3).random((40, 30)) < share
    counted = np.zeros(occupied.shape, dtype=int)
    for row, column, row_end, column_end in rectangles(occupied).tolist():
        counted[row:row_end, column:column_end] += 1
    assert (counted == occupied).all()


def test_a_wall_of_cells_is_one_rectangle_in_its_place():
    cells = np.zeros((50, 80), dtype=np.int8)
    cells[10:40, 20:22] = 100
    grid = OccupancyGrid(cells, 0.05, (1.0, -2.0, np.pi / 2))
    pieces = pieces_of(Surroundings(grid=grid), CONFIG)
    assert len(pieces) == 1
    # x of the grid points along y of the poses
    low, high = pieces.corners[0].min(axis=0), pieces.corners[0].max(axis=0)
    assert low == pytest.approx([1.0 - 2.0, -2.0 + 1.0])
    assert high == pytest.approx([1.0 - 0.5, -2.0 + 1.1])


def test_unknown_cells_and_what_lies_beyond_them_are_occupied_where_that_is_said():
    grid = OccupancyGrid(np.full((10, 10), -1, dtype=np.int8), 0.1)
    assert len(pieces_of(Surroundings(grid=grid), CONFIG)) == 0
    closed = pieces_of(Surroundings(grid=grid), CONFIG.model_copy(update={"unknown_is_free": False}))
    robot = PlacedFootprint(Footprint.rectangle(0.2, 0.2))
    for place in ((0.5, 0.5), (5.0, 0.5), (-1.0, -1.0), (0.5, 1.5)):
        assert min(gap_to(robot, closed, i, (*place, 0.0))[0] for i in range(len(closed))) < 0.0


def test_a_corridor_lies_beside_its_reference():
    reference = load_trajectory("circle")
    length = float(reference.sample([reference.duration]).arc_length[0])
    corridor = Corridor([0.0, length], [0.4, 0.4], [0.6, 0.6])
    pieces = pieces_of(Surroundings(corridor=corridor), CONFIG, reference)
    robot = PlacedFootprint(Footprint(((0.0, 0.0),), 0.1))
    for time in np.linspace(0.5, reference.duration - 0.5, 7):
        pose = reference.sample([time]).pose[0]
        gaps = [gap_to(robot, pieces, i, pose)[0] for i in range(len(pieces))]
        assert min(gaps) == pytest.approx(0.3, abs=0.01)


SQUARE = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
BAD = {
    "value that is not finite": Surroundings([[[0, 0], [1, np.nan], [1, 1]]]),
    "no area": Surroundings([[[0, 0], [1, 1], [2, 2]]]),
    "cross each other": Surroundings([[SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]]]),
    "lengths are in m": Surroundings([[[0, 0], [1e9, 0], [0, 1e9]]]),
    "its position has no time": Surroundings(discs=[MovingDisc(0, 0, 0.2, 1.0, 0.0)]),
    "velocity or radius": Surroundings(discs=[MovingDisc(0, 0, 0.2, np.nan)], time=0.0),
    "faster than": Surroundings(discs=[MovingDisc(0, 0, 0.2, 1e3)], time=0.0),
    "at most 250,000": Surroundings(grid=OccupancyGrid(np.zeros((1000, 1000), dtype=np.int8), 0.05)),
    "resolution nan": Surroundings(grid=OccupancyGrid(np.zeros((10, 10), dtype=np.int8), np.nan)),
    "cells from 0 to 120": Surroundings(grid=OccupancyGrid(np.full((2, 2), [0, 120], dtype=np.int16), 0.05)),
    "its origin": Surroundings(grid=OccupancyGrid(np.zeros((2, 2), dtype=np.int8), 0.05, (0.0, np.inf, 0.0))),
    "rectangles": Surroundings(
        grid=OccupancyGrid((np.indices((200, 200)).sum(axis=0) % 2 * 100).astype(np.int8), 0.05)
    ),
    "does not increase": Surroundings(corridor=Corridor([0.0, 0.0], [1.0, 1.0], [1.0, 1.0])),
    "negative": Surroundings(corridor=Corridor([0.0, 1.0], [1.0, -1.0], [1.0, 1.0])),
    "their time": Surroundings([SQUARE], time=np.nan),
}


@pytest.mark.parametrize("words", list(BAD))
def test_surroundings_that_cannot_be_used_get_one_line(words):
    with one_line_error(SurroundingsError, words):
        pieces_of(BAD[words], CONFIG, load_trajectory("circle"))


@pytest.mark.parametrize(
    "footprint", ["[[0, 0]]", "[[0, 0], [1, 1]]", "[[0]]", "x", "[" * 1500, "[[0, NaN], [1, 0], [1, 1]]"]
)
def test_a_footprint_that_is_none_is_refused(footprint):
    with pytest.raises(ValueError, match="footprint"):
        FreeSpace(footprint=footprint)


def test_the_gradient_of_a_half_space_is_that_of_finite_differences():
    rng = np.random.default_rng(1)
    function, plain = half_space_formula(), half_space_function()
    for _ in range(20):
        pose, parameters = rng.normal(size=3), rng.normal(size=5)
        value, gradient = function(pose, np.zeros(2), np.zeros(2), np.zeros(4), parameters)
        assert float(value) == pytest.approx(float(plain(pose, parameters)))
        slopes = differences(lambda moved, fixed=parameters: plain(moved, fixed), pose)
        assert gradient.full()[:1, :3] == pytest.approx(slopes, abs=1e-8)


@pytest.mark.parametrize("seed", range(10))
def test_planes_leave_the_free_plan_alone_and_part_it_from_everything_near(seed):
    """A free pose stays inside all planes; with enough rows every near obstacle is beyond a plane."""
    rng = np.random.default_rng(seed)
    polygons = [random_hull(rng, 6, 0.2) + rng.uniform(-1.5, 1.5, 2) for _ in range(8)]
    pieces, robot = pieces_of(Surroundings(polygons), CONFIG), PlacedFootprint(Footprint.rectangle(0.5, 0.4))
    poses = np.column_stack([rng.uniform(-1.5, 1.5, (40, 2)), rng.uniform(-3.0, 3.0, 40)])
    gaps, _ = least_gaps(robot, pieces, poses, np.zeros(40), 5.0)
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
        corners = placed(robot.footprint.corners, pose)
        used = planes[owners >= 0]
        for a_x, a_y, d_x, d_y, b in used:
            point = placed(np.array([[d_x, d_y]]), pose)[0]
            assert point @ [a_x, a_y] <= b + 1e-9
            assert (corners @ [a_x, a_y]).max() <= b + 1e-9
        for polygon in polygons:
            if edge_distance(corners, polygon) < 0.39:
                beyond = [(polygon @ plane[:2]).min() >= plane[4] - 1e-5 for plane in used]
                assert any(beyond)
