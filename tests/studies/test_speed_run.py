"""The speed benchmark from end to end with subjects that need no environment of their own, and what goes wrong."""

import json

import pytest

from diffdrive_mpc.bench.study import carry_out
from diffdrive_mpc.models.checked_yaml import ConfigError
from studies.speed.process.subject import Subject, SubjectError
from studies.speed.settings import SubjectSettings, chosen, load_speed_settings
from studies.speed.study import SpeedStudy


@pytest.fixture(scope="module")
def small():
    settings = chosen(load_speed_settings(quick=True), ["ours/daqp", "casadi/sqpmethod"])
    return settings.model_copy(update={"horizons": (10,), "ticks": 30, "gap_every": 5})


@pytest.fixture(scope="module")
def report(small, tmp_path_factory):
    out = tmp_path_factory.mktemp("speed")
    broken = SubjectSettings(kind="nlpsol", settings={"plugin": "nobody", "options": {}})
    carry_out(SpeedStudy(small.model_copy(update={"subjects": {**small.subjects, "broken": broken}})), out)
    return json.loads((out / "speed.json").read_text())


@pytest.mark.long
def test_everyone_solves_the_same_problem(report):
    ours, peer = report["records"]
    assert (ours["solver"], peer["solver"]) == ("ours/daqp", "casadi/sqpmethod")
    assert ours["unsolved"] == peer["unsolved"] == 0
    assert peer["gap_v_max"] < 1e-6
    assert peer["gap_omega_max"] < 1e-6
    assert ours["gap_v_p50"] < 1e-3
    assert ours["gap_omega_p50"] < 1e-3
    assert ours["closed_loop_cost"] == pytest.approx(peer["closed_loop_cost"], rel=0.01)


def test_limits_are_active_for_part_of_the_drive(report):
    assert all(record["active_share"] > 0.05 for record in report["records"])


def test_times_are_in_order_and_counted(report):
    for record in report["records"]:
        assert 0 < record["solver_p50_s"] <= record["step_max_s"]
        assert record["step_p50_s"] <= record["step_p95_s"] <= record["step_p99_s"] <= record["step_max_s"]
        assert 0 < record["samples"] <= 60
        assert 0 <= record["clean_share"] <= 1
        assert record["memory_bytes"] > record["memory_growth_bytes"] > 0


def test_a_subject_that_cannot_be_built_is_named_and_the_others_go_on(report):
    (missing,) = report["missing"]
    assert missing["solver"] == "broken"
    assert "nobody" in missing["reason"]


def test_a_process_that_dies_leaves_its_last_words(tmp_path):
    with Subject("nlpsol", tmp_path / "work", python="/bin/false") as subject, pytest.raises(SubjectError):
        subject.build({}, {}, None)


def test_groups_of_subjects_are_chosen_by_their_common_name():
    settings = load_speed_settings()
    assert list(chosen(settings, ["ours"]).subjects) == [name for name in settings.subjects if name.startswith("ours/")]
    assert list(chosen(settings, ["acados"]).subjects) == ["acados", "acados/hard"]
    with pytest.raises(ConfigError, match="nobody"):
        chosen(settings, ["nobody"])
