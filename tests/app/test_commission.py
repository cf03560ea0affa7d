"""`commission`: the chain on a simulated robot, its gates, what is done again and what is not."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from opened_report import content_of

from commands import call
from diffdrive_mpc import ConfigError, load_config
from diffdrive_mpc.app.commission import chain
from diffdrive_mpc.app.commission.chain import Logs
from diffdrive_mpc.app.commission.commissioning import (
    CommissionRequest,
    NeedsAPersonError,
    commission,
    with_stated_topics,
)
from diffdrive_mpc.app.commission.ledger import DriveSettings, Gate, Ledger, key_of
from diffdrive_mpc.app.commission.run import commission_into, drawn_robot, write_drawn_robot
from diffdrive_mpc.models.logs.mapping import load_mapping
from diffdrive_mpc.models.stated_robot import load_stated_robot
from diffdrive_mpc.sim.plants.simulated_robot import load_simulated_robot
from diffdrive_mpc_extras.excitation.model_excitation import Room
from quick_settings import quick_settings

STEPS = ["excite-slow", "record-slow", "learn", "excite", "record", "identify", "twin", "prove"]


@pytest.fixture(autouse=True, scope="module")
def quick_search():
    with quick_settings():
        yield


@pytest.fixture(scope="module")
def commissioned(tmp_path_factory):
    """One robot, commissioned in the shortest form, with what was said of each step."""
    out, said = tmp_path_factory.mktemp("commission"), []
    asked = CommissionRequest(Room(5.0, 4.0), "heavy", jobs=1).quick()
    assert commission(asked, out, on_step=lambda name, done, new: said.append((name, done, new)))
    return asked, out, said


def repeated(asked, out):
    """Names of the steps that are done when the commissioning is called again."""
    new = []
    commission(asked, out, on_step=lambda name, _done, fresh: new.append(name) if fresh else None)
    return new


def test_every_step_passes_and_says_so_in_a_sentence(commissioned):
    _, out, said = commissioned
    assert [name for name, _, new in said if new] == STEPS
    for _, done, _ in said:
        assert done.passed
        assert done.sentence
        assert "\n" not in done.sentence
    report = (out / "robot" / "report.md").read_text()
    assert all(done.sentence in report for _, done, _ in said)
    assert "fewer than" in said[-1][1].sentence
    assert not list(out.rglob(".unfinished*"))


def test_what_is_left_can_be_used(commissioned):
    _, out, _ = commissioned
    config = load_config(out / "robot" / "config.yaml")
    assert config.model == str(out / "robot" / "model.yaml")
    # Sideways slip of a skid-steer that turns: behind zero, and no more than the physics has on any floor.
    assert 0.0 < config.estimator.side_slip < 0.2
    twin = load_simulated_robot(out / "robot" / "twin.yaml")
    truth = load_simulated_robot("heavy")
    assert twin.twin.link.dead_time == pytest.approx(truth.twin.link.dead_time, abs=0.015)
    assert (out / "robot" / "proof.md").is_file()
    assert (out / "robot" / "first_circle.yaml").is_file()


def test_the_command_does_the_same_and_what_it_leaves_drives(commissioned):
    """What was asked for in Python is what the words ask for: nothing is left to do."""
    _, out, said = commissioned
    before = (out / "commission.json").read_bytes()
    printed = call("commission", "heavy", "--inside", "5x4", "--out", out, "--quick", "--jobs", "1")
    assert all(name in printed for name, _, _ in said)
    assert (out / "commission.json").read_bytes() == before
    config = str(out / "robot" / "config.yaml")
    driven = call("simulate", "--config", config, "--plant", "mujoco:heavy", "--trajectory", "square")
    assert "final mode: TRACKING" in driven


def test_its_page_shows_each_step_and_the_delivered_controller_on_the_twin(commissioned):
    asked, out, said = commissioned
    assert commission_into(asked, out)
    page = content_of(out / "report.html")
    assert [row[0] for row in page["tables"][0]["rows"]] == STEPS
    assert page["key_figures"][0]["value"] == f"{len(said)} of {len(said)}"
    assert [run["name"] for run in page["views"][0]["runs"]] == ["circle on the twin", "s on the twin"]


def test_what_is_done_is_not_done_again(commissioned):
    asked, out, _ = commissioned
    assert repeated(asked, out) == []
    # A drive that is lost is driven again, to the same log: what follows need not be done again.
    (out / "record" / "log.csv").unlink()
    assert repeated(asked, out) == ["record"]


def test_what_was_tuned_is_proven_and_delivered(commissioned, monkeypatch):
    """A tuning that writes a configuration of its own, which names the model from its place."""
    asked, out, _said = commissioned

    def tune(config, folder, *, plan, plant, jobs):
        assert plan is None
        assert jobs == 1
        assert plant == out / "twin" / "plant.yaml"
        words = config.read_text().replace("model: model.yaml", "model: ../identify/model.yaml")
        (folder / "config.yaml").write_text(words + "weights: {across: 777.0}\n")
        return SimpleNamespace(sentence="the objective is lower", improved=True)

    monkeypatch.setattr("diffdrive_mpc.app.tune.study.tune", tune)
    assert repeated(replace(asked, tuned=True), out) == ["tune", "prove"]
    config = load_config(out / "robot" / "config.yaml")
    assert config.weights.across == 777.0
    assert config.model == str(out / "robot" / "model.yaml")
    assert "the objective is lower." in (out / "robot" / "report.md").read_text()


def test_a_person_drives(commissioned, tmp_path):
    """The same logs, taken as those of a person: the command asks for one, then for the next."""
    _, out, _ = commissioned
    mine = CommissionRequest(Room(5.0, 4.0), jobs=1).quick()
    assert commission(mine, tmp_path, one_step=True)
    with pytest.raises(NeedsAPersonError, match=r"drive .*excite-slow/drive.yaml on the robot"):
        commission(mine, tmp_path, one_step=True)
    log = tmp_path / "my_log.csv"
    shutil.copy2(out / "record-slow" / "log.csv", log)
    with_log = replace(mine, logs=(log,))
    # A log is of one drive: it goes on to the next one that a person has to drive, and does not take it for that.
    with pytest.raises(NeedsAPersonError, match=r"excite/drive.yaml on the robot"):
        commission(with_log, tmp_path)
    assert (tmp_path / "record-slow" / "my_log.csv").is_file()
    log.unlink()
    with pytest.raises(NeedsAPersonError, match=r"excite/drive.yaml on the robot"):
        commission(mine, tmp_path)
    assert list(json.loads((tmp_path / "commission.json").read_text())["steps"]) == STEPS[:4]


def test_a_gate_that_does_not_open_ends_it(tmp_path):
    """In so little time and with so little speed the first drive cannot promise enough."""
    said = []
    slow = DriveSettings(seconds=8.0, speed=0.01, yaw_rate=0.01)
    asked = replace(CommissionRequest(Room(5.0, 4.0), "heavy").quick(), slow=slow)
    assert not commission(asked, tmp_path, on_step=lambda name, done, _: said.append((name, done)))
    assert [name for name, _ in said] == ["excite-slow"]
    assert said[0][1].sentence.endswith("too little; give more room or time")
    assert not (tmp_path / "robot").exists()


def test_a_step_that_fails_leaves_nothing(tmp_path):
    ledger = Ledger(tmp_path)

    def half(folder):
        (folder / "half.txt").write_text("half")
        raise ConfigError("no")

    with pytest.raises(ConfigError):
        ledger.carry_out("identify", "key", half)
    assert not list(tmp_path.iterdir())
    done = ledger.carry_out("identify", "key", lambda folder: Gate(bool((folder / "a").write_text("1")), "done"))
    assert Ledger(tmp_path).valid("identify", "key") == done
    assert Ledger(tmp_path).valid("identify", "another key") is None
    (tmp_path / "identify" / "a").write_text("2")
    assert Ledger(tmp_path).valid("identify", "key") is None


def test_the_key_follows_content_not_place(tmp_path):
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "log.csv").write_text("1")
    assert key_of("twin", {"s": 1}, [tmp_path / "one"]) == key_of("twin", {"s": 1}, [tmp_path / "other"])
    assert key_of("twin", {"s": 1}, [tmp_path / "one"]) != key_of("twin", {"s": 2}, [tmp_path / "one"])
    (tmp_path / "other" / "log.csv").write_text("2")
    assert key_of("twin", {"s": 1}, [tmp_path / "one"]) != key_of("twin", {"s": 1}, [tmp_path / "other"])


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 2**31))
def test_every_drawn_robot_is_one(tmp_path_factory, seed):
    path = tmp_path_factory.getbasetemp() / "drawn.yaml"
    write_drawn_robot(seed, path)
    robot = load_simulated_robot(path)
    assert drawn_robot(seed) == drawn_robot(seed)
    assert 0.05 <= robot.twin.link.dead_time <= 0.2
    assert 0.95 <= robot.firmware.track / robot.robot.track <= 1.36


def test_a_ledger_of_something_else_is_refused(tmp_path):
    (tmp_path / "commission.json").write_text("[1]")
    with pytest.raises(ConfigError, match="not written by this command"):
        Ledger(tmp_path)


def test_a_makers_robot_names_the_topics_of_bags_and_bounds_what_is_identified(tmp_path, monkeypatch):
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("")
    request = with_stated_topics(CommissionRequest(Room(4, 3), logs=(bag,), stated="husky"), tmp_path)
    assert load_mapping(request.mapping) == load_stated_robot("husky").mapping()
    later = with_stated_topics(CommissionRequest(Room(4, 3), stated="husky"), tmp_path)
    assert later.mapping == request.mapping
    plain = CommissionRequest(Room(4, 3), logs=(tmp_path / "drive.csv",), stated="husky")
    assert with_stated_topics(plain, tmp_path / "other").mapping is None
    asked = []
    monkeypatch.setattr(chain, "identify", lambda *_, **options: asked.append(options) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        chain.identify_all(tmp_path, Logs((bag,), request.mapping, request.stated))
    assert asked == [{"structure": "sm", "robot": "husky"}]
