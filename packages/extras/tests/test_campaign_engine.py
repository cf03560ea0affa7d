"""Campaign engine: definition and hash of a run, stored rows, repeated runs, and the table."""

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
from diffdrive_mpc_extras.campaign.drive import RecordedController, built, drive, drive_run
from diffdrive_mpc_extras.campaign.engine import (
    CampaignPlace,
    CampaignTask,
    OtherVersionError,
    Store,
    describe_errors,
    drive_all,
    run_task,
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
def short_trajectory(tmp_path: Path) -> Path:
    path = tmp_path / "short.yaml"
    path.write_text(SHORT, encoding="utf-8")
    return path


@pytest.fixture
def campaign(tmp_path: Path, short_trajectory: Path) -> Path:
    path = tmp_path / "campaign.yaml"
    path.write_text(FILE, encoding="utf-8")
    return path


def test_repeated_campaign_simulates_no_run(campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    assert "6 runs, 6 completed" in call("campaign", campaign, "--out", out, "--jobs", "1")
    first_table = read_table(out / "results.parquet")

    def fail(_: object) -> None:
        raise AssertionError("run was repeated")

    monkeypatch.setattr("diffdrive_mpc_extras.campaign.engine.drive", fail)
    call("campaign", campaign, "--out", out, "--jobs", "1")
    # The comparison includes the columns of time.
    assert read_table(out / "results.parquet").equals(first_table)


def test_table_does_not_depend_on_processes_parts_and_copied_folders(campaign: Path, tmp_path: Path) -> None:
    complete, first, second = (tmp_path / name for name in ("whole", "first", "second"))
    call("campaign", campaign, "--out", complete, "--jobs", "2", "--runs", "16")
    call("campaign", campaign, "--out", first, "--jobs", "1", "--runs", "16", "--part", "1/2")
    call("campaign", campaign, "--out", second, "--jobs", "1", "--runs", "16", "--part", "2/2")
    assert read_table(first / "results.parquet").num_rows == 8
    shutil.copytree(second / "runs", first / "runs", dirs_exist_ok=True)
    call("campaign", campaign, "--out", first, "--jobs", "1", "--runs", "16")
    expected = read_table(complete / "results.parquet", times=False)
    assert read_table(first / "results.parquet", times=False).equals(expected)
    assert expected.num_rows == 16


def test_damaged_and_missing_rows_are_repeated(campaign: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    call("campaign", campaign, "--out", out, "--jobs", "1", "--runs", "2")
    expected = read_table(out / "results.parquet", times=False)
    rows = sorted(out.glob("runs/*/*.json"))
    rows[0].write_text(rows[0].read_text(encoding="utf-8")[:100], encoding="utf-8")
    rows[1].unlink()
    call("campaign", campaign, "--out", out, "--jobs", "1", "--runs", "2")
    assert read_table(out / "results.parquet", times=False).equals(expected)


def test_row_equals_the_result_of_simulate() -> None:
    case = quick_case(sensors="default")
    row = drive(Definition(case))
    run, _ = drive_run(Definition(case))
    metrics = run.metrics
    assert (row["position_rmse_m"], row["steps"]) == (metrics.position_rmse_m, metrics.steps)
    assert row["ticks_tracking"] == run.modes.count("TRACKING")
    assert sum(value for name, value in row.items() if name.startswith("ticks_")) == len(run.time)  # type: ignore[misc]


def test_hash_covers_factors_files_and_environment(
    short_trajectory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = Definition.from_factors({"trajectory": str(short_trajectory), "plant": "model:sm"})
    keys = {key_of(first)}
    for second in (
        first.with_seed(1),
        first.with_factors({"config.horizon": 20}),
        first.with_factors({"sensors.pose.latency": 0.03}),
        Definition.from_factors({"trajectory": "circle", "plant": "model:sm"}),
    ):
        keys.add(key_of(second))
    assert len(keys) == 5
    copied_file = tmp_path / "elsewhere.yaml"
    copied_file.write_bytes(short_trajectory.read_bytes())
    assert key_of(replace(first, case=replace(first.case, trajectory=str(copied_file)))) == key_of(first)
    copied_file.write_text(SHORT.replace("0.3", "0.35"), encoding="utf-8")
    assert key_of(replace(first, case=replace(first.case, trajectory=str(copied_file)))) != key_of(first)
    other_numpy = definition.environment() | {"numpy": "0.1"}
    monkeypatch.setattr(definition, "environment", lambda: other_numpy)
    assert key_of(first) not in keys


def test_hash_covers_referenced_files(tmp_path: Path) -> None:
    model = tmp_path / "model.yaml"
    shipped = Path(definition.models.__file__).parent / "parameters" / "sm.yaml"
    model.write_text(shipped.read_text(encoding="utf-8"), encoding="utf-8")
    config = tmp_path / "config.yaml"
    config.write_text("model: model.yaml\nhorizon: 20\n", encoding="utf-8")
    run = Definition.from_factors({"config": str(config)})
    first_key = key_of(run)
    model.write_text(f"# another text\n{model.read_text(encoding='utf-8')}", encoding="utf-8")
    assert key_of(run) != first_key


def test_worker_with_different_files_raises_an_error(short_trajectory: Path) -> None:
    task = CampaignTask.for_run(Definition.from_factors({"trajectory": str(short_trajectory), "plant": "model:sm"}))
    assert run_task(task)["completed"] is True
    short_trajectory.write_text(SHORT.replace("0.3", "0.2"), encoding="utf-8")
    with pytest.raises(OtherVersionError, match="has a different version of this product"):
        run_task(task)


def test_error_of_a_run_is_in_its_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    definition = Definition(quick_case())

    def refuse(*_: object, **__: object) -> None:
        raise ZeroDivisionError("of a test")

    monkeypatch.setattr(drive_module, "simulate", refuse)
    with ProgressBar("") as bar:
        runs = drive_all([definition, definition], CampaignPlace(tmp_path, 1), bar)
    assert len(runs) == 1
    assert runs[0].row["completed"] is False
    assert describe_errors(runs).endswith("ZeroDivisionError: of a test")


def test_factor_replaces_only_its_own_value_in_the_robot_file(tmp_path: Path) -> None:
    """Use a robot file with sensors and friction like a file of `twin`; pose latency must not change the gyro."""
    surface = {"description": "noisy", "friction": 0.3, "sensors": {"gyro": {"noise_sd": 0.5, "bias_sd": 0.0}}}
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump(surface), encoding="utf-8")

    def reading_and_gain(**factors: float) -> tuple[float, float]:
        values = {"plant": f"mujoco:{path}", "seed": 3} | factors
        with built(Definition.from_factors(values)) as (_, plant, _):
            plant.reset(np.zeros(3))
            speeds = []
            for _ in range(30):
                plant.advance([2.0, 0.0])
                speeds.append(plant.true_twist[0])
            yaw_rate = plant.measure().yaw_rate
            return float(yaw_rate.value), max(speeds)

    expected = reading_and_gain()
    assert abs(expected[0]) > 0.02
    assert reading_and_gain(**{"sensors.pose.latency": 0.1, "surface.slip.side_slip": 0.1}) == expected


@pytest.mark.parametrize(
    ("factors", "text"),
    [
        ({"robot.robot.mas": 8.0}, "unknown key 'robot.mas'; did you mean 'robot.mass'?"),
        ({"robot.robot.mass": 8.0, "plant": "model:sm"}, "the plant 'model:sm' has no robot file"),
    ],
)
def test_invalid_factor_is_reported_before_the_first_run(factors: dict[str, object], text: str, tmp_path: Path) -> None:
    with ProgressBar("") as bar, pytest.raises(ConfigError) as error:
        drive_all([Definition.from_factors({}), Definition.from_factors(factors)], CampaignPlace(tmp_path, 1), bar)  # type: ignore[arg-type]
    assert text in str(error.value)
    assert "a run with " in str(error.value)
    assert not Store(tmp_path).keys()


def test_invalid_part_is_reported_in_one_line(campaign: Path, tmp_path: Path) -> None:
    line = "--part 3/2: give the number of the part and the number of parts, such as 2/8"
    assert line in call("campaign", campaign, "--out", tmp_path / "out", "--part", "3/2", code=2)


NO_VIOLATIONS = Unsafe(0, 0, 0, 0)
BLACKOUT = """
description: poses are lost permanently while the robot drives
drop_outs: [{sensor: pose, start: 2.0, duration: 60.0}]
"""


@pytest.mark.parametrize("scenario", ["sensor_dropouts", "push", "frozen_pose", "pose_jump"])
def test_controller_satisfies_its_stated_limits(scenario: str) -> None:
    row = drive(Definition.from_factors({"scenario": scenario, "model": "sm"}))
    assert row["error"] == ""
    assert [row[f"unsafe_{name}"] for name in ("not_finite", "limit", "slew", "motion")] == [0] * 4


def test_stop_after_a_loss_of_poses_is_in_time_and_delayed_commands_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "blackout.yaml"
    path.write_text(BLACKOUT, encoding="utf-8")
    definition = Definition.from_factors(
        {"scenario": str(path), "plant": "model:ssm", "config.failure.dead_reckoning": 0.0}
    )
    controller, plant, reference = build(definition.case)
    recorded = RecordedController(controller)
    run = simulate(recorded, plant, reference)
    assert run.modes[-1] == "STOPPED"
    assert recorded.unsafe(definition) == NO_VIOLATIONS
    # Commands with a delay of half a second violate the motion limit.
    delay = int(0.5 / run.sample_time)
    recorded.commands = [*[recorded.commands[0]] * delay, *recorded.commands[:-delay]]
    counts = recorded.unsafe(definition)
    assert counts.motion >= delay - 2


def test_command_rejected_by_the_loop_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    step = RecordedController.step

    def step_with_nan(self: RecordedController, t: float, measurement: Measurement) -> ControlStep:
        result = step(self, t, measurement)
        if len(self.times) == 30:
            self.commands[-1] = (np.nan, 0.0)
            raise ValueError("the controller's command must be two finite numbers")
        return result

    monkeypatch.setattr(drive_module.RecordedController, "step", step_with_nan)
    row = drive(Definition.from_factors({"plant": "model:ssm"}))
    assert row["unsafe_not_finite"] == 1
    assert row["completed"] is False
    assert "two finite numbers" in str(row["error"])
