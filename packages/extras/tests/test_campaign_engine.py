"""The campaign engine: what defines a run, what is kept, what is driven again, and the table."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from bench_parts import quick_case

from commands import call
from diffdrive_mpc.bench.controllers import build
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import ControlStep, Measurement
from diffdrive_mpc.sim import simulate
from diffdrive_mpc_extras.campaign import definition
from diffdrive_mpc_extras.campaign import drive as drive_module
from diffdrive_mpc_extras.campaign.command_check import Unsafe
from diffdrive_mpc_extras.campaign.definition import Definition, key_of
from diffdrive_mpc_extras.campaign.drive import RecordedController, built, drive, drive_whole
from diffdrive_mpc_extras.campaign.engine import (
    CampaignPlace,
    CampaignTask,
    OtherVersionError,
    Store,
    do,
    drive_all,
    failed,
)
from diffdrive_mpc_extras.campaign.run import read_table

SHORT = "name: short\nsegments:\n- {v: 0.3, omega: 0.4, duration: 0.5}\n"
FILE = """
description: of a test
runs: 6
factors:
  trajectory: short.yaml
  plant: "model:sm"
  model: {one_of: [ssm, sm]}
  sensors.pose.latency: {uniform: [0.0, 0.1]}  # s
"""


@pytest.fixture
def short(tmp_path: Path) -> Path:
    path = tmp_path / "short.yaml"
    path.write_text(SHORT, encoding="utf-8")
    return path


@pytest.fixture
def campaign(tmp_path: Path, short: Path) -> Path:
    path = tmp_path / "campaign.yaml"
    path.write_text(FILE, encoding="utf-8")
    return path


def test_a_repeated_campaign_drives_nothing(campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    assert "6 runs, 6 completed" in call("campaign", campaign, "--out", out, "--jobs", "1")
    before = read_table(out / "results.parquet")

    def none_is_driven(_: object) -> None:
        raise AssertionError("driven again")

    monkeypatch.setattr("diffdrive_mpc_extras.campaign.engine.drive", none_is_driven)
    call("campaign", campaign, "--out", out, "--jobs", "1")
    # Times included: nothing was measured again.
    assert read_table(out / "results.parquet").equals(before)


def test_processes_parts_and_copied_folders_give_the_same_table(campaign: Path, tmp_path: Path) -> None:
    whole, first, second = (tmp_path / name for name in ("whole", "first", "second"))
    call("campaign", campaign, "--out", whole, "--jobs", "2", "--runs", "16")
    call("campaign", campaign, "--out", first, "--jobs", "1", "--runs", "16", "--part", "1/2")
    call("campaign", campaign, "--out", second, "--jobs", "1", "--runs", "16", "--part", "2/2")
    assert read_table(first / "results.parquet").num_rows == 8
    shutil.copytree(second / "runs", first / "runs", dirs_exist_ok=True)
    call("campaign", campaign, "--out", first, "--jobs", "1", "--runs", "16")
    expected = read_table(whole / "results.parquet", times=False)
    assert read_table(first / "results.parquet", times=False).equals(expected)
    assert expected.num_rows == 16


def test_a_file_that_was_cut_off_is_driven_again(campaign: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    call("campaign", campaign, "--out", out, "--jobs", "1", "--runs", "2")
    expected = read_table(out / "results.parquet", times=False)
    rows = sorted(out.glob("runs/*/*.json"))
    rows[0].write_text(rows[0].read_text(encoding="utf-8")[:100], encoding="utf-8")
    rows[1].unlink()
    call("campaign", campaign, "--out", out, "--jobs", "1", "--runs", "2")
    assert read_table(out / "results.parquet", times=False).equals(expected)


def test_run_gives_the_result_of_simulate() -> None:
    case = quick_case(sensors="default")
    row = drive(Definition(case))
    run, _ = drive_whole(Definition(case))
    metrics = run.metrics
    assert (row["position_rmse_m"], row["steps"]) == (metrics.position_rmse_m, metrics.steps)
    assert row["ticks_tracking"] == run.modes.count("TRACKING")
    assert sum(value for name, value in row.items() if name.startswith("ticks_")) == len(run.time)  # type: ignore[misc]


def test_the_hash_knows_everything_that_decides(short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = Definition.from_factors({"trajectory": str(short), "plant": "model:sm"})
    keys = {key_of(first)}
    for second in (
        first.with_seed(1),
        first.changed({"config.horizon": 20}),
        first.changed({"sensors.pose.latency": 0.03}),
        Definition.from_factors({"trajectory": "circle", "plant": "model:sm"}),
    ):
        keys.add(key_of(second))
    assert len(keys) == 5
    moved = tmp_path / "elsewhere.yaml"
    moved.write_bytes(short.read_bytes())
    assert key_of(replace(first, case=replace(first.case, trajectory=str(moved)))) == key_of(first)
    moved.write_text(SHORT.replace("0.3", "0.35"), encoding="utf-8")
    assert key_of(replace(first, case=replace(first.case, trajectory=str(moved)))) != key_of(first)
    other_numpy = definition.environment() | {"numpy": "0.1"}
    monkeypatch.setattr(definition, "environment", lambda: other_numpy)
    assert key_of(first) not in keys


def test_the_hash_knows_files_that_a_file_names(tmp_path: Path) -> None:
    model = tmp_path / "model.yaml"
    shipped = Path(definition.models.__file__).parent / "parameters" / "sm.yaml"
    model.write_text(shipped.read_text(encoding="utf-8"), encoding="utf-8")
    config = tmp_path / "config.yaml"
    config.write_text("model: model.yaml\nhorizon: 20\n", encoding="utf-8")
    run = Definition.from_factors({"config": str(config)})
    before = key_of(run)
    model.write_text(f"# another text\n{model.read_text(encoding='utf-8')}", encoding="utf-8")
    assert key_of(run) != before


def test_who_has_other_files_does_not_drive(short: Path) -> None:
    task = CampaignTask.for_run(Definition.from_factors({"trajectory": str(short), "plant": "model:sm"}))
    assert do(task)["completed"] is True
    short.write_text(SHORT.replace("0.3", "0.2"), encoding="utf-8")
    with pytest.raises(OtherVersionError, match="has another version of this product"):
        do(task)


def test_a_run_that_cannot_go_on_has_its_error_in_its_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    definition = Definition(quick_case())

    def refuse(*_: object, **__: object) -> None:
        raise ZeroDivisionError("of a test")

    monkeypatch.setattr(drive_module, "simulate", refuse)
    with ProgressBar("") as bar:
        driven = drive_all([definition, definition], CampaignPlace(tmp_path, 1), bar)
    assert len(driven) == 1
    assert driven[0].row["completed"] is False
    assert failed(driven).endswith("ZeroDivisionError: of a test")


def test_a_factor_changes_what_the_robot_has_and_nothing_else(tmp_path: Path) -> None:
    """A robot file with sensors and a floor of its own, as a twin is: late poses do not make its gyro better."""
    surface = {"description": "noisy", "friction": 0.3, "sensors": {"gyro": {"noise_sd": 0.5, "bias_sd": 0.0}}}
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump(surface), encoding="utf-8")

    def reading_and_gain(**factors: float) -> tuple[float, float]:
        named = {"plant": f"mujoco:{path}", "seed": 3} | factors
        with built(Definition.from_factors(named)) as (_, plant, _):
            plant.reset(np.zeros(3))
            speeds = []
            for _ in range(30):
                plant.advance([2.0, 0.0])
                speeds.append(plant.true_twist[0])
            yaw_rate = plant.measure().yaw_rate
            return float(yaw_rate.value), max(speeds)

    plain = reading_and_gain()
    assert abs(plain[0]) > 0.02
    assert reading_and_gain(**{"sensors.pose.latency": 0.1, "surface.slip.side_slip": 0.1}) == plain


@pytest.mark.parametrize(
    ("factors", "line"),
    [
        ({"robot.robot.mas": 8.0}, "unknown key 'robot.mas'; did you mean 'robot.mass'?"),
        ({"robot.robot.mass": 8.0, "plant": "model:sm"}, "the plant 'model:sm' has no robot file"),
    ],
)
def test_a_mistake_is_found_before_the_first_run(factors: dict[str, object], line: str, tmp_path: Path) -> None:
    with ProgressBar("") as bar, pytest.raises(ConfigError) as caught:
        drive_all([Definition.from_factors({}), Definition.from_factors(factors)], CampaignPlace(tmp_path, 1), bar)  # type: ignore[arg-type]
    assert line in str(caught.value)
    assert "a run with " in str(caught.value)
    assert not Store(tmp_path).keys()


def test_a_mistake_on_the_command_line_is_one_line(campaign: Path, tmp_path: Path) -> None:
    line = "--part 3/2: give the number of the part and of how many, such as 2/8"
    assert line in call("campaign", campaign, "--out", tmp_path / "out", "--part", "3/2", code=2)


NONE = Unsafe(0, 0, 0, 0)
BLACKOUT = """
description: poses stay away for good while the robot drives
drop_outs: [{sensor: pose, start: 2.0, duration: 60.0}]
"""


@pytest.mark.parametrize("scenario", ["sensor_dropouts", "push", "frozen_pose", "pose_jump"])
def test_the_controller_keeps_what_it_states(scenario: str) -> None:
    row = drive(Definition.from_factors({"scenario": scenario, "model": "sm"}))
    assert row["error"] == ""
    assert [row[f"unsafe_{name}"] for name in ("not_finite", "limit", "slew", "motion")] == [0] * 4


def test_without_poses_it_stops_in_time_and_one_tick_later_would_be_found(tmp_path: Path) -> None:
    path = tmp_path / "blackout.yaml"
    path.write_text(BLACKOUT, encoding="utf-8")
    definition = Definition.from_factors(
        {"scenario": str(path), "plant": "model:ssm", "config.failure.dead_reckoning": 0.0}
    )
    controller, plant, reference = build(definition.case)
    watched = RecordedController(controller)
    run = simulate(watched, plant, reference)
    assert run.modes[-1] == "STOPPED"
    assert watched.unsafe(definition) == NONE
    # What is sent half a second late is motion that was not allowed.
    late = int(0.5 / run.sample_time)
    watched.commands = [*[watched.commands[0]] * late, *watched.commands[:-late]]
    counts = watched.unsafe(definition)
    assert counts.motion >= late - 2


def test_a_command_that_the_loop_refuses_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    step = RecordedController.step

    def poisoned(self: RecordedController, t: float, measurement: Measurement) -> ControlStep:
        result = step(self, t, measurement)
        if len(self.times) == 30:
            self.commands[-1] = (np.nan, 0.0)
            raise ValueError("the controller's command must be two finite numbers")
        return result

    monkeypatch.setattr(drive_module.RecordedController, "step", poisoned)
    row = drive(Definition.from_factors({"plant": "model:ssm"}))
    assert row["unsafe_not_finite"] == 1
    assert row["completed"] is False
    assert "two finite numbers" in str(row["error"])
