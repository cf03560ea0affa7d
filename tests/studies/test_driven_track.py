"""P3's drives and P2's comparison on made-up and short drives."""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_mpc.models.logs import Record
from studies.reproduce.drive_models import (
    EXPERIMENTAL,
    NO_MODEL,
    PHYSICAL,
    compare_on_twin,
    drive_model_findings,
    drive_model_tables,
    reversing_commands,
    velocity_errors,
)
from studies.reproduce.driven_track import DrivenTrack, drive_tests, driven_track_findings
from studies.reproduce.published import load_published, load_study
from studies.reproduce.virtual_track import fit_line

STUDY = load_study(quick=True).driven_track
FEW = STUDY.model_copy(
    update={"tests": ((0.3, 0.3), (0.35, 0.6), (0.4, 1.0)), "yaw_rates": (0.4, 0.8, 1.2), "speeds": (0.2, 0.5, 0.8)}
)


@pytest.fixture(scope="module")
def floors() -> list[DrivenTrack]:
    return [drive_tests(FEW, surface) for surface in ("default", "slippery")]


def test_friction_and_wheel_base_give_the_track_on_the_spot(floors):
    """Coulomb friction under four wheels: track (1 + (wheel base / track)^2), on any floor, at any yaw rate."""
    for floor in floors:
        (spot, *_) = floor.alone.values()
        assert spot[:, 2] == pytest.approx(0.33 * (1 + (0.14 / 0.33) ** 2), rel=0.02)


def test_less_friction_makes_the_centripetal_force_matter_more(floors):
    default, slippery = (floor.by_acceleration for floor in floors)
    assert slippery.p1 < 3 * default.p1 < 0


def test_a_track_that_grows_is_seen_to_grow():
    yaw = np.linspace(0.3, 1.0, 8)
    rows = np.column_stack([0.3 * np.ones(8), yaw, 0.286 + 0.049 * yaw + 1e-4 * (-1) ** np.arange(8), np.ones(8)])
    made = DrivenTrack("made", rows, {}, fit_line(rows[:, 1:3]))
    made = DrivenTrack("made", rows, dict.fromkeys(("turning on the spot, over yaw rate", "b"), rows), made.line)
    made.alone["at constant yaw rate, over v"] = rows[:, [1, 0, 2, 3]]
    grows, alone, spot = driven_track_findings([made], load_published())
    assert (grows.verdict, alone.verdict, spot.verdict) == ("yes", "no", "yes")
    assert made.line.p1 == pytest.approx(0.049, rel=0.01)


def test_commands_go_both_ways_as_fast_as_stated():
    study = load_study().drive_models
    commands = np.vstack([reversing_commands(study, seed, smooth=False) for seed in range(20)])
    assert np.abs(commands).max(axis=0) == pytest.approx([0.6, 1.1], rel=0.02)
    assert np.abs(np.mean(commands > 0, axis=0) - 0.5).max() < 0.1


def test_errors_count_where_there_are_readings_and_in_the_paper_s_units():
    fresh = np.arange(60) % 2 == 0
    twist = np.where(fresh[:, None], 0.2, 9.0) * np.ones((60, 2))
    twist[1::2] = np.nan
    record = Record("made", 0.0, 0.05, np.zeros((60, 2)), twist=twist, yaw_rate=np.full(60, 0.1))
    errors = velocity_errors([np.zeros((60, 2))], [record])
    assert errors.v == pytest.approx((200.0, 200.0))
    assert errors.omega == pytest.approx((np.degrees(0.1), np.degrees(0.1)))


@pytest.mark.long
def test_both_drive_models_beat_no_model_on_a_short_drive():
    study = load_study(quick=True).drive_models.model_copy(update={"drives": 2, "duration": 15.0})
    result = compare_on_twin(study, 77)
    for name in (PHYSICAL, EXPERIMENTAL):
        assert result.errors[name].v[0] < 0.5 * result.errors[NO_MODEL].v[0]
        assert result.errors[name].omega[0] < result.errors[NO_MODEL].omega[0]
    errors, numbers = drive_model_tables([result], load_published())
    assert {cells[0] for cells in errors.rows} == {"P2, first data set", "P2, second data set", "simulated robot"}
    assert len(numbers.rows) == 2
    assert drive_model_findings([result], load_published())[0].verdict == "yes"
