"""The search: what fixes it, what an interruption leaves, and which points are never chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from tune_parts import searched, small_plan

from diffdrive_mpc.app.tune.objective import predicted_p99
from diffdrive_mpc.app.tune.tune_file import StepTime
from diffdrive_mpc.bench.campaign.definition import Definition
from diffdrive_mpc.bench.campaign.engine import CampaignRun, drive_all
from diffdrive_mpc.bench.case import Case

DRIVE = "diffdrive_mpc.app.tune.search.drive_all"


def test_a_seed_fixes_the_study_and_an_interruption_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = small_plan(tmp_path)
    whole = searched(plan, tmp_path / "whole")
    assert [one.number for one in whole.points] == list(range(11))
    assert whole.points[0].values == {"weights.across": 700.0, "weights.omega_increment": 35.0, "horizon": 30}
    assert (whole.points[0].value, whole.points[0].usable) == (1.0, True)
    assert 0 < len(whole.usable) < 11
    calls = iter(range(1000))

    def interrupted(*given: object, **named: object) -> list[CampaignRun]:
        # Once after the first fidelity of the first group, once before anything of the last one.
        if next(calls) in (5, 8):
            raise KeyboardInterrupt
        return drive_all(*given, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(DRIVE, interrupted)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            searched(plan, tmp_path / "parts")
    assert searched(plan, tmp_path / "parts") == whole
    other = searched(plan.model_copy(update={"search_seed": 1}), tmp_path / "whole")
    assert other.points[0] == whole.points[0]
    assert other.points[1:] != whole.points[1:]


def test_workers_share_a_study(tmp_path: Path) -> None:
    plan = small_plan(tmp_path)
    first = searched(plan.model_copy(update={"points": 6}), tmp_path / "out")
    both = searched(plan, tmp_path / "out", worker=2)
    assert both.points[:6] == first.points
    assert len(both.points) == 11
    # Random numbers of its own: no point is tried twice.
    assert len({tuple(one.values.values()) for one in both.points}) == 11


def test_a_point_with_an_unsafe_command_is_never_chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = small_plan(tmp_path)
    free = searched(plan, tmp_path / "free")
    assert free.best.number > 0
    forbidden = free.best.values["weights.omega_increment"]

    def unsafe(definitions: Sequence[Definition], *given: object) -> list[CampaignRun]:
        found = drive_all(definitions, *given)  # type: ignore[arg-type]
        hit = [("weights.omega_increment", forbidden) in one.definition.case.overrides for one in found]
        return [replace(one, row=one.row | {"unsafe_limit": int(bad)}) for one, bad in zip(found, hit, strict=True)]

    monkeypatch.setattr(DRIVE, unsafe)
    held = searched(plan, tmp_path / "held")
    one = held.points[free.best.number]
    assert (one.values, one.usable, one.broken) == (free.best.values, False, "unsafe")
    assert held.best.number != one.number
    assert one not in held.front


def test_a_horizon_that_takes_too_long_is_not_driven(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []

    def grows(stated: StepTime, usual: Case, values: dict[str, int]) -> float:
        asked.append(values)
        return stated.p99 * values.get("horizon", 30) / 30.0

    monkeypatch.setattr("diffdrive_mpc.app.tune.search.predicted_p99", grows)
    plan = small_plan(tmp_path, step_time={"machine": "a small computer", "p99": 3.0e-4, "at_most": 3.3e-4})
    found = searched(plan, tmp_path / "out")
    long = [one for one in found.points if one.values["horizon"] > 33]  # type: ignore[operator]
    assert long
    assert all((one.fidelity, one.broken, one.usable) == (0, "step time", False) for one in long)
    assert all(one.fidelity for one in found.points if one not in long)
    # What was measured is kept with the study.
    count = len(asked)
    assert count == len({one.values["horizon"] for one in found.points})
    assert searched(plan, tmp_path / "out") == found
    assert len(asked) == count


def test_processor_time_grows_with_the_horizon(tmp_path: Path) -> None:
    stated = StepTime(machine="a small computer", p99=1.0e-3, at_most=2.0e-3)
    usual = small_plan(tmp_path).runs(small_plan(tmp_path).tuning, 1, {"model": "ssm"}, {})[0].case
    assert predicted_p99(stated, usual, {"weights.across": 300.0}) == stated.p99
    assert predicted_p99(stated, usual, {"horizon": 120}) > 1.3 * stated.p99


def test_constraints_may_have_runs_of_their_own(tmp_path: Path) -> None:
    beside = {"column": "recovery_overshoot_m", "runs": 1, "factors": {"scenario": "start_offset"}}
    plan = small_plan(tmp_path, points=6, constraints={"overshoot": beside | {"at_most": -1.0}})
    found = searched(plan, tmp_path / "out")
    # No overshoot is below zero: nothing can be used, the defaults neither, and the defaults remain.
    assert {one.broken for one in found.points if one.fidelity == 2} == {"overshoot"}
    assert (found.usable, found.best.number) == ([], 0)
