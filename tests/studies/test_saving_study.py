"""The saving study: pairs, the drives' energy, statistics, cones, and the whole of it, small."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commands import invoke
from diffdrive_mpc import ConfigError, load_config
from diffdrive_mpc_extras.planner import Plan, plan
from diffdrive_mpc_extras.turn_costs import load_turn_costs, load_vehicle
from studies.cli import app
from studies.saving.drives import PairOutcome, PlanDrive, Saved, drive_closed, drive_open, standing_from, worse_arrival
from studies.saving.scenarios import gap_to_posts, loaded_costs
from studies.saving.settings import DrawnTasks, Pair, SavingStudySettings, draw_pairs, load_study, small

STUDY = load_study()


def driven(
    measured: float, *, predicted: float = 1.0, seconds: float = 1.0, arrived: bool = True, position: float = 0.0
) -> PlanDrive:
    """A drive of which only this matters."""
    return PlanDrive(
        1.0, seconds, predicted, measured, seconds, position, 0.0, 0.0, 0.0, arrived, np.zeros((1, 3)), np.zeros((1, 3))
    )


def pairs_of(*rows: tuple[float, float]) -> list[PairOutcome]:
    """Pairs with these energies, energy-optimal and distance-optimal."""
    pair = Pair((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    return [
        PairOutcome("x", k, pair, {"energy": driven(own), "distance": driven(other)}, None, "")
        for k, (own, other) in enumerate(rows)
    ]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The quick study by the command line."""
    out = tmp_path_factory.mktemp("saving")
    invoke(app, "saving", "--quick", "--jobs", "1", "--out", out)
    return out


def test_the_quick_study_saves_and_arrives(report: Path) -> None:
    found = json.loads((report / "saving.json").read_text())
    (floor,) = found["floors"]
    assert floor["pairs"] == len(found["pairs"]) == 2
    assert floor["saving"] == pytest.approx(np.mean([one["saving"] for one in found["pairs"]]))
    for one in found["pairs"]:
        for aim in ("energy", "distance"):
            assert one[aim]["arrived"] and one[aim]["position"] < 0.05
            assert abs(one[aim]["error"]) < 0.2
        assert one["energy"]["predicted"] <= one["distance"]["predicted"] * 1.001
        assert one["energy"]["length"] >= one["distance"]["length"] * 0.999
        fed, shortest = one["energy_with_computer"], one["distance"]
        assert fed["arrived"] and abs(fed["error"]) < 0.2 and fed["length"] <= one["energy"]["length"] * 1.01
        assert fed["measured"] <= shortest["measured"] + STUDY.computer * shortest["seconds"]
        assert one["saving"] == pytest.approx(1 - one["energy"]["measured"] / one["distance"]["measured"])


def test_a_plan_without_slip_goes_astray_open_loop_and_not_in_closed_loop(report: Path) -> None:
    without, with_slip = json.loads((report / "saving.json").read_text())["scenarios"]
    assert without["open"]["position"] > 2 * with_slip["open"]["position"]
    assert without["closed"]["position"] < 0.05 and with_slip["closed"]["position"] < 0.05
    assert abs(with_slip["closed"]["error"]) < abs(without["closed"]["error"])


def test_report_and_figures_are_there(report: Path) -> None:
    names = {path.name for path in (report / "figures").iterdir()}
    assert names == {"saving.png", "prediction.png", "paths-default.png", "scenario-1.png"}


def test_savings_are_those_of_the_pairs() -> None:
    found = Saved.of(pairs_of((90, 100), (80, 100), (210, 200)))
    assert found.mean.value == pytest.approx((0.1 + 0.2 - 0.05) / 3)
    assert found.total == pytest.approx(1 - 380 / 400)
    assert (found.least, found.most) == (pytest.approx(-0.05), pytest.approx(0.2))
    assert (found.pairs, found.worse) == (3, 1)
    assert found.mean.low < found.mean.value < found.mean.high


def test_the_interval_is_that_of_the_mean_of_pairs() -> None:
    savings = np.random.default_rng(3).normal(0.10, 0.04, 30)
    found = Saved.of(pairs_of(*((100 * (1 - one), 100.0) for one in savings))).mean
    spread = 1.96 * savings.std(ddof=1) / math.sqrt(30)
    assert found.value == pytest.approx(savings.mean())
    assert found.high - found.value == pytest.approx(spread, rel=0.2)
    assert found.value - found.low == pytest.approx(spread, rel=0.2)


def test_who_does_not_arrive_says_nothing_of_saving() -> None:
    lost = pairs_of((50, 100))[0]._replace(drives={"energy": driven(50, arrived=False), "distance": driven(100)})
    found = Saved.of([*pairs_of((90, 100), (90, 100)), lost])
    assert found.pairs == 2 and found.mean.value == pytest.approx(0.1)
    assert math.isnan(Saved.of([lost]).mean.value)
    assert math.isnan(pairs_of((90, 100))[0].saving("time"))


def test_a_computer_costs_who_drives_longer() -> None:
    one = pairs_of((50, 100))[0]._replace(
        drives={"energy": driven(50, seconds=30), "distance": driven(100, seconds=10)}
    )
    assert one.saving() == pytest.approx(0.5)
    assert one.saving(computer=2.5) == pytest.approx(0.0)
    # Planned with it: what it drew is in the measured energy of that drive already.
    assert math.isnan(one.saving_fed(2.5))
    assert one._replace(fed=driven(100, seconds=12)).saving_fed(2.5) == pytest.approx(0.2)
    assert math.isnan(one._replace(fed=driven(100, arrived=False)).saving_fed(2.5))


def test_arrival_is_compared_pair_by_pair() -> None:
    rows = pairs_of((1, 1), (1, 1))
    worse = [
        one._replace(drives={"energy": driven(1, position=0.02 + 0.01 * k), "distance": driven(1, position=0.01 * k)})
        for k, one in enumerate(rows)
    ]
    position, heading = worse_arrival(worse)
    assert position.value == pytest.approx(0.02) and heading.value == 0.0


def test_pairs_follow_from_their_seed_and_are_spread_evenly() -> None:
    asked = STUDY.pairs
    pairs = draw_pairs(asked, asked.count, asked.seed)
    assert pairs == draw_pairs(asked, asked.count, asked.seed)
    assert not {*pairs} & {*draw_pairs(asked, asked.count, asked.tuning_seed)}
    low, high = asked.distance
    far = [(one.distance - low) / (high - low) for one in pairs]
    bearing = [(math.atan2(one.goal[1], one.goal[0]) + math.pi) / (2 * math.pi) for one in pairs]
    heading = [(one.goal[2] + math.pi) / (2 * math.pi) for one in pairs]
    for values in (far, bearing, heading):
        assert sorted(int(asked.count * value) for value in values) == list(range(asked.count))


def test_pairs_that_were_tuned_on_are_not_reported() -> None:
    with pytest.raises(ValueError, match="tuning_seed are the same"):
        DrawnTasks(count=3, seed=1, tuning_seed=1, distance=(1.0, 2.0))


def test_quick_is_a_part_of_the_whole() -> None:
    quick = small(STUDY)
    assert {*quick.surfaces} <= {*STUDY.surfaces} and quick.pairs.count < STUDY.pairs.count
    assert quick.pairs.seed == STUDY.pairs.seed
    load_config(STUDY.configuration)


def test_a_robot_stands_when_it_no_longer_moves_again() -> None:
    twist = np.zeros((6, 3))
    twist[[0, 1, 3], [0, 2, 0]] = 0.5
    assert standing_from(twist, STUDY.standing) == 4
    assert standing_from(np.zeros((3, 3)), STUDY.standing) == 0
    assert standing_from(np.ones((3, 3)), STUDY.standing) == 3


@settings(max_examples=50, deadline=None)
@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-4, 4), st.floats(0.05, 0.3))
def test_the_gap_to_a_cone_is_that_of_the_nearest_point_of_the_outline(
    x: float, y: float, theta: float, radius: float
) -> None:
    length, width = 0.5, 0.4
    along, across = np.linspace(-length / 2, length / 2, 201), np.linspace(-width / 2, width / 2, 201)
    points = np.stack(np.meshgrid(along, across), -1).reshape(-1, 2)
    c, s = math.cos(theta), math.sin(theta)
    nearest = np.hypot(*(points @ np.array([[c, s], [-s, c]]) - [x, y]).T).min()
    gap = gap_to_posts(np.array([[0.0, 0.0, theta]]), ((x, y, radius),), (length, width))
    if nearest > 0.003:
        assert gap == pytest.approx(nearest - radius, abs=0.003)
    else:
        assert gap <= -radius + 0.003


def straight() -> Plan:
    """Three metres straight on."""
    return plan(load_turn_costs(STUDY.costs_of("default")), (0.0, 0.0, 0.0), (3.0, 0.0, 0.0), speed=STUDY.speed)


def test_a_straight_drive_takes_what_the_drag_takes() -> None:
    ahead, bot = straight(), load_vehicle(STUDY.robot)
    work = 2 * bot.drag_torque * 3.0 / bot.wheel_radius
    for way in (drive_closed, drive_open):
        found = way(STUDY, ahead, "default")
        assert found.arrived and found.saturated == 0
        assert work < found.measured < 1.6 * work


def test_the_same_drive_twice_takes_the_same() -> None:
    ahead = straight()
    assert drive_closed(STUDY, ahead, "carpet").measured == drive_closed(STUDY, ahead, "carpet").measured


def test_where_all_tyres_slide_a_payload_asks_for_torque_as_it_weighs() -> None:
    asked = next(one for one in STUDY.scenarios if one.kind == "loaded")
    own = load_turn_costs(STUDY.costs_of("slippery"))
    loaded = loaded_costs(STUDY, asked.model_copy(update={"surface": "slippery"}), own)
    turn = np.array([[0.4, 0.4]])
    drag = own.vehicle.drag_torque
    empty, heavy = (costs.torques(turn)[0, 1] - drag for costs in (own, loaded))
    assert loaded.vehicle.mass == pytest.approx(own.vehicle.mass + asked.payload)
    assert heavy / empty == pytest.approx(loaded.vehicle.mass / own.vehicle.mass, rel=0.12)


def test_cones_in_the_way_are_refused() -> None:
    scenarios = (STUDY.scenarios[0].model_copy(update={"posts": ((0.2, 0.0, 0.1),)}),)
    from studies.saving.study import SavingStudy

    blocked: SavingStudySettings = STUDY.model_copy(update={"scenarios": scenarios})
    with pytest.raises(ConfigError, match="a post stands where the robot's start is"):
        SavingStudy(blocked).plan()
