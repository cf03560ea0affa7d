"""From a log to a drive model that a controller loads: what the log tells, what keeps its prior, what is refused."""

import csv

import numpy as np
import pytest
from log_parts import drive, write_csv, write_mapping

from diffdrive_mpc import ConfigError, Controller, identify, load_config, load_model
from diffdrive_mpc.models.identification.log_data import LogData
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc_extras.drives.drive_model import DriveModel, drive_model
from diffdrive_mpc_extras.drives.finding import told_by
from diffdrive_mpc_extras.drives.fitting import fit_drive
from diffdrive_mpc_extras.model_comparison.model_comparison import KINDS, compare_models

DT, STILL = 0.04, (0.005, 0.02)
DEAD = (3, 2)
NO_LIMIT = 200.0
LIMITED = [np.array([0.95, 1.0, 1.6, 0.1, 0.0, 0.0]), np.array([0.8, 2.0, 3.0, 0.06, 0.0, 0.0])]
UNLIMITED = [np.array([0.95, NO_LIMIT, NO_LIMIT, 0.1, 0.0, 0.0]), np.array([0.8, NO_LIMIT, NO_LIMIT, 0.06, 0.0, 0.0])]


def driven(coefficients, seed, seconds=40.0, *, backwards=True):
    """Noisy readings of a sharp experimental drive whose set-points change every 0.8 s."""
    rng = np.random.default_rng(seed)
    low = -1.0 if backwards else 0.3
    commands = np.repeat(rng.uniform(low, 1.0, (round(seconds / 0.8), 2)), round(0.8 / DT), axis=0)
    robot = drive_model("robot", "drive_experimental", DT, DEAD, STILL, coefficients)
    x, window = np.zeros(robot.order), np.zeros((robot.memory + 1, 2))
    twist = np.empty_like(commands)
    for k, command in enumerate(commands):
        window = np.vstack([window[1:], command])
        twist[k] = x[[1, 5]]
        x = robot.sharp(x, window.ravel()).full().ravel()
    noisy = twist + rng.normal(0, [0.005, 0.01], twist.shape)
    return Record(f"drive {seed}", 0.0, DT, commands, twist=noisy, yaw_rate=noisy[:, 1] + 0.01)


def told(coefficients, kind="drive_experimental", **how):
    records = [driven(coefficients, 1, **how)]
    return told_by(fit_drive(kind, records), records)


def test_slope_limits_that_act_are_told_within_their_uncertainty():
    found = told(LIMITED)
    assert not {"v.quicker", "v.slower", "omega.quicker", "omega.slower"} & set(found.kept)
    assert {"v.threshold", "v.threshold_by_slope"} <= set(found.kept), "this robot never stands still"
    # Rounding gives up some of the limit at its corner, which no noise explains.
    for row, channel in enumerate(("v", "omega")):
        for name, truth in zip(("gain", "quicker", "slower"), LIMITED[row], strict=False):
            assert found.estimate.value(f"{channel}.{name}") == pytest.approx(truth, rel=0.12), name
    assert found.fit.dead_samples == DEAD
    assert found.estimate.deviation("v.gain") < 0.02


def test_what_a_log_does_not_show_keeps_its_prior():
    """No slope that acts, and never a change of direction: neither limit nor threshold can be told."""
    found = told(UNLIMITED, backwards=False)
    untold = {"quicker", "slower", "threshold", "threshold_by_slope"}
    assert set(found.kept) == {f"{channel}.{name}" for channel in ("v", "omega") for name in untold}
    for values in found.fit.values:
        assert values["quicker"] == values["slower"] == NO_LIMIT
        assert values["threshold"] == values["threshold_by_slope"] == 0.0
    assert "v.quicker" not in found.estimate.names
    assert found.estimate.value("v.lag") == pytest.approx(0.1, rel=0.15)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Half a minute of a robot with two first-order lags."""
    folder = tmp_path_factory.mktemp("log")
    write_mapping(folder / "map.yaml")
    return write_csv(folder / "drive.csv", drive(seconds=30.0, dt=0.04))


@pytest.mark.parametrize("structure", ["p2_experimental", "p2_physical"])
def test_from_a_log_to_a_drive_that_a_controller_loads(log, structure, tmp_path):
    found = identify(log, log.with_name("map.yaml"), structure)
    report = found.report
    assert report.fitted.validation.fit_percent.min() > 90.0
    assert report.as_json()["model"] == structure
    assert f"{structure}.v.gain" in report.as_json()["parameters"]
    assert structure.upper() in report.markdown()
    assert "Parameters of the linear model beside a drive" in report.markdown()
    assert any("none is modelled" in warning for warning in report.warnings), "no slope limit acts here"
    found.write(tmp_path)
    model = load_model(tmp_path / "model.yaml")
    assert isinstance(model, DriveModel)
    commands = np.repeat(np.random.default_rng(0).uniform(-1, 1, (4, 2)), 20, axis=0)
    assert model.simulate(commands) == pytest.approx(found.model.simulate(commands), abs=1e-3)
    # The robot: lags of 0.1 s, and a gyro that sees what it does.
    # PI control with the paper's slow integral makes up for what its gain lacks only after seconds.
    within = 0.02 if structure == "p2_experimental" else 0.04
    assert np.diag(model.dc_gain) == pytest.approx([1.0, 1.0], abs=within)
    answer = model.simulate(np.full((100, 2), 0.5)) / 0.5
    risen = DT * np.argmax(answer > 1 - np.exp(-1), axis=0)
    assert risen == pytest.approx([0.1, 0.1], abs=DT)
    config = load_config(tmp_path / "config.yaml")
    assert config.sample_time == model.dt == 0.04
    assert Controller(config).model.structure == model.structure


def test_the_part_held_out_has_a_drive_of_its_own(log):
    """The stand-in for the robot is of the same kind: an SM would take a slope limit for a lag."""
    found = identify(log, log.with_name("map.yaml"), "p2_experimental")
    other = found.report.fitted.predictor.refitted(found.report.data.validation, "gyro")
    assert isinstance(other, DriveModel)
    assert np.diag(other.dc_gain) == pytest.approx(np.diag(found.model.dc_gain), abs=0.05)
    assert other.dc_gain[0, 0] != found.model.dc_gain[0, 0]


def test_a_signal_that_is_missing_is_one_line(log, tmp_path):
    rows = list(csv.DictReader(log.open()))
    columns = {name: [row[name] for row in rows] for name in ("t", "v_ref", "omega_ref", "gyro")}
    write_csv(tmp_path / "poor.csv", columns)
    write_mapping(
        tmp_path / "map.yaml",
        "columns: {time: t, command: {v: v_ref, omega: omega_ref}, gyro: {yaw_rate: gyro}}\n",
    )
    with pytest.raises(ConfigError, match="readings of twist, fewer than 5; log that signal") as refused:
        identify(tmp_path / "poor.csv", tmp_path / "map.yaml", "p2_physical")
    assert "\n" not in str(refused.value)
    with pytest.raises(ConfigError, match="they stand around an sm, not an p2_physical"):
        identify(log, log.with_name("map.yaml"), "p2_physical", effects=True)


def data_of(*records):
    return LogData(tuple(records[:1]), tuple(records[1:]), ("made up",), "nothing", "gyro", (), ())


@pytest.mark.long
def test_a_base_that_limits_slopes_is_a_drive_and_no_sm():
    data = data_of(driven(LIMITED, 2), driven(LIMITED, 3))
    found = compare_models(data, ["sm", "p2_experimental"], parts=2)
    assert [one.states for one in found.scores] == [0, 4, 8]
    assert found.recommended.kind == "p2_experimental"
    assert "sm is worse by" in found.sentence()


def test_slow_kinds_take_part_only_where_they_are_named(monkeypatch):
    """And where what they need is not installed, the sentence says so, and the others are compared."""
    monkeypatch.setattr("diffdrive_mpc_extras.model_comparison.model_comparison.KINDS", [KINDS[0], KINDS[-1]])
    monkeypatch.setitem(__import__("sys").modules, "jax", None)
    data = data_of(driven(UNLIMITED, 4, 10.0), driven(UNLIMITED, 5, 10.0))
    assert KINDS[-1].slow
    assert [one.kind for one in compare_models(data, parts=2).scores[1:]] == [KINDS[0].name]
    for asked in (["all"], ["sm", KINDS[-1].name]):
        found = compare_models(data, asked, parts=2)
        assert [one.kind for one in found.scores[1:]] == [KINDS[0].name, KINDS[-1].name]
        assert "lstm was not found: training a network needs JAX" in found.sentence()
        assert found.recommended.kind == "sm"
