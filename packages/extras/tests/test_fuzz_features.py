"""Controllers with features satisfy the guarantees of docs/safety.md in random sessions."""

from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

from diffdrive_mpc import Controller
from diffdrive_mpc_extras.free_space import Corridor, MovingDisc, OccupancyGrid, Surroundings
from fuzz import odd
from fuzz.case import draw, saved_findings
from fuzz.configs import Overrides
from fuzz.controller import EXTRAS, ControllerFuzzer, Session, one_line
from fuzz.runner import check_within_bounds


def draw_surroundings(random: Random) -> Any:
    """Draw polygons, discs, a grid or a corridor, or None to remove the surroundings."""
    if random.random() < 0.1:
        return None
    result: dict[str, Any] = {"later": random.choice((0.0, 0.0, 0.0, -1.0, 5.0, None, odd.number(random)))}
    if random.random() < 0.6:
        result["polygons"] = [_polygon(random) for _ in range(random.choice((1, 2, 5, 30)))]
    if random.random() < 0.6:
        result["discs"] = [
            [_offset(random), _offset(random), abs(_number(random, 0.2)), _number(random, 0.5), _number(random, 0.5)]
            for _ in range(random.choice((1, 2, 10)))
        ]
    if random.random() < 0.3:
        rows, columns = random.choice(((1, 1), (20, 20), (60, 40), (1, 200), (0, 5)))
        result["grid"] = {
            "shape": [rows, columns],
            "seed": random.randrange(1000),
            "share": random.choice((0.0, 0.02, 0.2, 1.0)),
            "resolution": random.choice((0.05, 0.05, 0.2, abs(_number(random, 0.1)))),
            "origin": [_offset(random), _offset(random), _number(random, 1.0)],
        }
    if random.random() < 0.3:
        count = random.choice((0, 1, 2, 5, 50))
        lengths = sorted(abs(_number(random, 3.0)) for _ in range(count))
        result["corridor"] = [
            lengths if random.random() < 0.9 else lengths[::-1],
            [abs(_number(random, 0.5)) for _ in range(count)],
            [abs(_number(random, 0.5)) for _ in range(count)],
        ]
    return result


def make_surroundings(case: Any, pose: np.ndarray, t: float) -> Surroundings | None:
    """Build the object that a case describes, with positions relative to the robot."""
    if case is None:
        return None
    grid = corridor = None
    if "grid" in case:
        costmap = case["grid"]
        rng = np.random.default_rng(costmap["seed"])
        cells = np.where(rng.random(costmap["shape"]) < costmap["share"], 100, rng.integers(-1, 2, costmap["shape"]))
        origin = (pose[0] + costmap["origin"][0], pose[1] + costmap["origin"][1], costmap["origin"][2])
        grid = OccupancyGrid(cells.astype(np.int8), costmap["resolution"], origin)
    if "corridor" in case:
        corridor = Corridor(*case["corridor"])
    return Surroundings(
        polygons=[np.asarray(points, dtype=float) + pose[:2] for points in case.get("polygons", ())],
        discs=[MovingDisc(pose[0] + x, pose[1] + y, radius, vx, vy) for x, y, radius, vx, vy in case.get("discs", ())],
        grid=grid,
        corridor=corridor,
        time=None if case["later"] is None else t + case["later"],
    )


def _polygon(random: Random) -> list[list[float]]:
    x, y, size = _offset(random), _offset(random), random.choice((0.05, 0.2, 1.0, 1e-6))
    if random.random() < 0.7:
        return [[x, y], [x + size, y], [x + size, y + size], [x, y + size]]
    return [[x + _number(random, size), y + _number(random, size)] for _ in range(random.choice((0, 2, 3, 3, 4, 6)))]


def _offset(random: Random) -> float:
    """Draw a position, mostly near the robot and rarely at the robot."""
    return random.choice((random.uniform(-3.0, 3.0), random.uniform(0.5, 2.0), _number(random, 1.0)))


def _number(random: Random, scale: float) -> float:
    return odd.number(random) if random.random() < 0.04 else random.gauss(0.0, scale)


FEATURES: tuple[Overrides, ...] = (
    {"energy.weight": 0.01, "energy.turn_costs": "fsu_bot-default"},
    {"energy.weight": 1.0, "energy.turn_costs": "fsu_bot-slippery", "energy.use_min_radius": True},
    {"rehearsal.enabled": True, "rehearsal.by": "laps"},
    {"rehearsal.enabled": True, "rehearsal.by": "floor"},
    {"free_space.enabled": True},
    {"free_space.enabled": True, "free_space.margin": 0.3},
)


class FeatureFuzzer(ControllerFuzzer):
    """Fuzzer of controllers whose configuration enables features."""

    name = "features"
    extras: Sequence[Overrides] = (*EXTRAS, *FEATURES)

    def draw_feature_events(self, random: Random, overrides: Overrides) -> list[list[Any]]:
        """Draw surroundings for a controller with the feature `free_space`."""
        if "free_space.enabled" not in overrides or random.random() < 0.5:
            return []
        return [["see", draw_surroundings(random)]]

    def make_session(self, controller: Controller, references: list[Any]) -> Session:
        """Return a session in which surroundings are set."""
        return FeatureSession(controller, references)


class FeatureSession(Session):
    """Session with obstacles and other surroundings."""

    def see(self, case: Any) -> None:
        """Set surroundings near the current pose, or remove them."""
        try:
            surroundings = make_surroundings(case, self.pose, self.t)
            self.controller.feature("free_space").set_obstacles(surroundings)
        except ValueError as error:
            one_line(error)


FINDINGS = saved_findings(Path(__file__).with_name("fuzz_findings"))


def test_drawn_cases_have_no_fault():
    fuzzer = FeatureFuzzer()
    cases = [draw(fuzzer, 30, index) for index in range(60)]
    for case in cases:
        check_within_bounds(fuzzer, case)
    assert all(any(extra.items() <= case["overrides"].items() for case in cases) for extra in FEATURES)
    assert "see" in {event[0] for case in cases for event in case["events"]}
    assert fuzzer.steps > 2000


@pytest.mark.parametrize("key", FINDINGS)
def test_earlier_finding_is_fixed(key):
    check_within_bounds(FeatureFuzzer(), FINDINGS[key])


def test_there_are_findings_to_replay():
    assert len(FINDINGS) > 5
