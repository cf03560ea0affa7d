"""Targets are judged by the runs, and by nothing else."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from tracking_parts import recovery, row

from diffdrive_mpc.bench.experiment import frame
from studies.tracking.measured import load_targets, worst_arc
from studies.tracking.study import judge, load_study, target_table

STUDY = load_study(quick=True)
CASES = [drive.case for drive in STUDY.drives(["targets"])["targets"]]


def verdicts(change=lambda case: {}):
    return {(v.what, v.where): v for v in judge(frame(row(case, **change(case)) for case in CASES))}


def only(**conditions):
    """Whether a case is the one that the conditions describe."""
    return lambda case: all(getattr(case, name) == value for name, value in conditions.items())


def test_runs_well_inside_every_target_reach_all_of_them():
    found = verdicts()
    assert len(found) == 5 + 2 + 3 + 4
    assert all(verdict.met for verdict in found.values())
    assert all(set(verdict.reached) == {"SM", "SSM"} for verdict in found.values())


PLAIN = {"scenario": "none", "sensors": "default"}


@pytest.mark.parametrize(
    ("where", "changes", "what", "place"),
    [
        ({**PLAIN, "surface": "default"}, {"position_rmse_m": 0.0061}, "position RMSE [m]", "default"),
        ({**PLAIN, "surface": "default"}, {"arcs": (0.001, -0.0031)}, "lateral error of the worst arc [m]", "default"),
        ({**PLAIN, "surface": "default"}, {"course_rmse_rad": 0.0101}, "course RMSE [rad]", "default"),
        ({**PLAIN, "surface": "default"}, {"heading_rmse_rad": 0.0151}, "heading RMSE [rad]", "default"),
        ({**PLAIN, "surface": "slippery"}, {"position_rmse_m": 0.021}, "position RMSE [m]", "slippery"),
        (
            {**PLAIN, "surface": "slippery", "trajectory": "s"},
            {"late_lateral_m": 0.051},
            "largest lateral after 2 s [m]",
            "slippery",
        ),
        ({"sensors": "slam", "trajectory": "s"}, {"completed": False}, "runs not completed", "slam sensors"),
        ({"sensors": "slam", "trajectory": "s"}, {"lateral_max_m": 0.151}, "largest lateral [m]", "slam sensors"),
        ({"sensors": "slam", "trajectory": "s"}, {"fallbacks": 1}, "fallbacks", "slam sensors"),
        (
            {"scenario": "start_offset", "trajectory": "s"},
            recovery(3.1, 0.01, 1.0, 1.0),
            "longest recovery [s]",
            "start_offset",
        ),
        (
            {"scenario": "false_command", "trajectory": "s"},
            recovery(1.0, 0.051, 1.0, 1.0),
            "largest overshoot [m]",
            "false_command",
        ),
        (
            {"scenario": "false_command", "trajectory": "s"},
            recovery(math.inf, math.nan, 1.0, 1.0),
            "longest recovery [s]",
            "false_command",
        ),
    ],
)
def test_one_model_beyond_a_limit_is_a_no_for_it_alone(where, changes, what, place):
    found = verdicts(lambda case: changes if only(model="sm", **where)(case) else {})
    verdict = found[what, place]
    assert not verdict.met
    assert not verdict.met_by("SM")
    assert verdict.met_by("SSM")
    others = {key for key, other in found.items() if not other.met} - {(what, place)}
    assert others <= {("position RMSE [m], the aim", "default"), ("largest overshoot [m]", place)}
    (cells,) = target_table([verdict]).rows
    sm, ssm = cells[3:5]
    assert "(no)" in sm
    assert "(no)" not in ssm
    assert cells[-1] == "no"


def test_a_value_at_the_limit_is_inside_it():
    limit = next(one.limit for one in load_targets().targets if one.what == "position RMSE [m]")
    found = verdicts(lambda case: {"position_rmse_m": limit})
    assert found["position RMSE [m]", "default"].met
    assert not found["position RMSE [m], the aim", "default"].met


def test_what_could_not_be_computed_reaches_nothing():
    found = verdicts(lambda case: {**recovery(), "course_rmse_rad": math.nan})
    assert not found["longest recovery [s]", "start_offset"].met
    assert not found["course RMSE [rad]", "default"].met


def test_the_worst_arc_is_the_largest_mean_over_seeds_whatever_its_side():
    case = CASES[0]
    other = replace(case, trajectory="cane")
    rows = [row(case, arcs=(0.001, -0.004)), row(case, arcs=(0.001, 0.002)), row(other, arcs=(0.0025,))]
    assert worst_arc(frame(rows)) == pytest.approx(0.003)
    assert math.isnan(worst_arc(frame([row(case, arcs=())])))
