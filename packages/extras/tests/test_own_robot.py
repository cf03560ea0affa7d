"""Robot of a configuration: plant, tubes from simulated drives, proof and passport."""

import json
import shutil

import numpy as np
import pytest
import yaml

from commands import call, refusal
from diffdrive_mpc.app.identification.unexplained_motion import write_robot
from diffdrive_mpc.app.run_log import run_log
from diffdrive_mpc.bench.controllers import run_case
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.load import model_path
from diffdrive_mpc.models.logs.drive_log.reader import read_drive_log
from diffdrive_mpc.mpc import Controller, load_config, load_trajectory
from diffdrive_mpc.sim.plants.identified_robot import IdentifiedRobot, intervals
from diffdrive_mpc.sim.plants.surface import load_surface
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from diffdrive_mpc_extras.campaign.own_plant import own_plant
from diffdrive_mpc_extras.predicted_error.drives import (
    absolute_errors,
    drive_case,
    predict_by_drives,
    scale_by_logs,
    tube,
)
from diffdrive_mpc_extras.proof.proof_file import load_proof, proof_of
from refusals import one_line_error

SHORT = """
name: short
timing: smooth
segments: [{v: 0.4, omega: 0.5, duration: 1.0}, {v: 0.4, omega: 0.0, duration: 1.0}]
"""


def robot(size=0.01):
    """Return a robot with unexplained motion of this standard deviation [m/s, rad/s]."""
    rows = np.repeat(np.random.default_rng(3).normal(size=(60, 3)), 25, axis=0)
    return IdentifiedRobot(
        model="model.yaml",
        slip=load_surface("default").slip,
        sensors=load_sensor_set("default"),
        sample_time=0.02,
        block_time=10.0,
        gain_deviation=(0.002, 0.01),
        delay_deviation=(0.002, 0.002),
        variance=[(size**2, 0.0, 0.0, 0.0, 0.0, 0.0)] * 3,
        largest=(1.0,) * 6,
        motion=[intervals(rows)],
    )


@pytest.fixture
def folder(tmp_path):
    """Return a folder with the files that `identify` writes."""
    shutil.copy(model_path("sm"), tmp_path / "model.yaml")
    (tmp_path / "config.yaml").write_text("model: model.yaml\n", encoding="utf-8")
    (tmp_path / "short.yaml").write_text(SHORT, encoding="utf-8")
    write_robot(robot(), tmp_path / "robot.yaml")
    return tmp_path


def test_plant_of_a_configuration_is_its_twin_or_its_identified_robot(folder):
    config = str(folder / "config.yaml")
    assert own_plant("ssm") == "mujoco"
    assert own_plant(config) == f"model:{folder / 'robot.yaml'}"
    (folder / "plant.yaml").write_text("description: twin\n", encoding="utf-8")
    assert own_plant(config) == f"mujoco:{folder / 'plant.yaml'}"
    for name in ("plant.yaml", "robot.yaml"):
        (folder / name).unlink()
    with one_line_error(ConfigError, match="neither plant.yaml .* give --plant"):
        own_plant(config)
    for arguments in (["prove", config], ["prove", config, "--tolerance", "0.05"]):
        assert "neither plant.yaml" in refusal(*arguments, "--out", folder / "out")
    assert "give --plant" in refusal("predict-error", "--config", config, "--trajectory", "s", "--out", folder / "out")


def test_recorded_drives_scale_the_tubes_and_too_few_are_refused(folder):
    config, path = str(folder / "config.yaml"), str(folder / "short.yaml")
    plant, logs = own_plant(config), [folder / f"{seed}.mcap" for seed in range(20)]
    for seed, log in enumerate(logs):
        case = drive_case(config, path, plant, 100 + seed)
        with run_log(log) as write:
            write(run_case(case), case)
    predicted = predict_by_drives(config, path, plant, 20)
    scaled = scale_by_logs(logs, predicted, load_config(config), plant, 20, 1)
    assert "scaled by 20 recorded drives of 16 m" in scaled.drives
    width = scaled.lateral.everywhere
    errors = np.abs([read_drive_log(log).columns["error_across_m"][: len(width)] for log in logs])
    is_inside = [np.nanmax(errors / (share * width), axis=1) <= 1.0 + 1e-9 for share in (1.0, 0.8)]
    assert is_inside[0].sum() >= 19 and not is_inside[1].all()
    with one_line_error(ConfigError, match="3 recorded drives: 95 % needs 19"):
        scale_by_logs(logs[:3], predicted, load_config(config), plant, 20, 1)
    options = ["--config", config, "--trajectory", path, "--draws", "20", "--out", folder / "predicted"]
    assert "1 recorded drive" in refusal("predict-error", *options, "--learn-from", logs[0])


def test_fast_displacements_widen_only_the_tube_along(folder):
    config, path = str(folder / "config.yaml"), str(folder / "short.yaml")
    before = predict_by_drives(config, path, own_plant(config), 20)
    write_robot(robot().model_copy(update={"displacement": 0.01}), folder / "robot.yaml")
    after = predict_by_drives(config, path, own_plant(config), 20)
    assert np.array_equal(after.lateral.everywhere, before.lateral.everywhere)
    assert (after.along.everywhere > 1.3 * before.along.everywhere).all()


def test_errors_depend_on_the_seed_and_grow_with_the_unexplained_motion(folder):
    config, path = str(folder / "config.yaml"), str(folder / "short.yaml")

    def max_error(seed):
        run = run_case(drive_case(config, path, own_plant(config), seed))
        return absolute_errors(run, 100)[0].max()

    errors = [max_error(seed) for seed in range(4)]
    assert errors[0] == max_error(0) and len(set(errors)) == 4
    write_robot(robot(0.06), folder / "robot.yaml")
    assert np.median([max_error(seed) for seed in range(4)]) > 1.5 * np.median(errors)


def artificial_errors(count, seed):
    """Return errors (count, 300) of similar drives: small on a straight, large in a turn."""
    rng = np.random.default_rng(seed)
    scale = np.where(np.arange(300) < 150, 0.002, 0.01) * rng.lognormal(sigma=0.4, size=(count, 1))
    return np.abs(scale * np.cumsum(rng.normal(size=(count, 300)), axis=1) / np.sqrt(np.arange(300) + 1.0))


def test_tube_contains_the_stated_fraction_of_held_out_drives():
    width = tube(artificial_errors(200, 1), 0.02)
    coverage = (artificial_errors(2000, 2) <= width.everywhere).all(axis=1).mean()
    assert 0.92 < coverage < 0.98
    assert 0.93 < (artificial_errors(2000, 3) <= width.at_each_place).mean() < 0.97
    assert width.everywhere[20:130].mean() < 0.6 * width.everywhere[170:280].mean()


def test_lost_drives_widen_a_tube_and_too_many_are_refused():
    errors = artificial_errors(60, 1)
    incomplete = errors.copy()
    incomplete[:2, 40:] = np.inf
    assert tube(incomplete, 0.02).everywhere.max() >= tube(errors[2:], 0.02).everywhere.max()
    incomplete[:10] = np.inf
    message = "50 of 60 simulated drives arrive: too few for 95 %; most frequent messages of the lost drives: late;"
    with one_line_error(ConfigError, match=message):
        tube(incomplete, 0.02, cause="late")


def test_predict_error_simulates_the_identified_robot(folder):
    files = ["--config", folder / "config.yaml", "--trajectory", folder / "short.yaml"]
    output = call("predict-error", *files, "--draws", "20", "--jobs", "1", "--out", folder / "out")
    assert "20 drives simulated on robot.yaml" in " ".join(output.split())
    rows = np.genfromtxt(folder / "out" / "predicted-error.csv", delimiter=",", names=True)
    assert (rows["lateral_everywhere"] >= rows["lateral"]).all() and (rows["lateral"] > 0.0005).all()


def test_proof_and_passport_use_the_identified_robot_and_its_surface(folder):
    proof = proof_of(str(folder / "config.yaml"), None, None)
    assert {run.case.plant for run in proof.definitions(8)} == {f"model:{folder / 'robot.yaml'}"}
    plan = proof.passport.model_dump() | {
        "search_runs": 3,
        "proof_runs": 4,
        "tries": 1,
        "share": 0.5,
        "confidence": 0.8,
    }
    plan |= {"curvatures": [0.0], "speeds": [0.3], "straight": 0.2, "arc": 0.2}
    (folder / "campaign.yaml").write_text(
        yaml.safe_dump({"description": "test", "runs": 1, "passport": plan}), encoding="utf-8"
    )
    options = ["--campaign", folder / "campaign.yaml", "--tolerance", "0.05", "--jobs", "1", "--out", folder / "out"]
    call("prove", folder / "config.yaml", *options)
    (row,) = json.loads((folder / "out" / "passport.json").read_text(encoding="utf-8"))["speeds"]
    assert (row["surface"], sum(rate["of"] for rate in row["fresh"].values())) == ("log", 4)
    runs = [json.loads(path.read_text(encoding="utf-8")) for path in (folder / "out" / "runs").glob("*/*.json")]
    assert runs and all(run["run"]["plant"].startswith("model:files ") for run in runs)


def test_passport_varies_track_wheel_base_and_wheel_servo_around_the_values_of_a_twin(folder):
    factors = set(load_proof(None).passport.factors)
    assert factors == {
        "robot.robot.track",
        "robot.twin.chassis.wheel_base",
        "robot.twin.driver.proportional_gain",
        "robot.twin.driver.integral_gain",
    }
    factor = proof_of("ssm", None, "mujoco:wide").passport.factors["robot.robot.track"]
    assert factor["uniform"] == pytest.approx([0.52 / 0.33 * 0.30, 0.52 / 0.33 * 0.36])


def test_node_predicts_for_the_identified_robot(folder):
    pytest.importorskip("rclpy")
    from diffdrive_mpc_extras.ros.path_error import ErrorPredictor, PredictedErrorSettings

    config = str(folder / "config.yaml")
    controller, settings = Controller(config), PredictedErrorSettings(error_population="own")
    reference = load_trajectory(folder / "short.yaml", controller.config)
    summary = json.loads(ErrorPredictor.build(controller, settings, config).summary(reference, controller.config))
    expected = predict_by_drives(config, str(folder / "short.yaml"), own_plant(config), 20)
    assert summary["population"] == "own"
    assert summary["lateral"]["everywhere"] == pytest.approx(expected.lateral.everywhere.max(), abs=1e-5)
    with one_line_error(ConfigError, match="use another population with follow_error_limit"):
        ErrorPredictor.build(controller, settings.model_copy(update={"follow_error_limit": 0.1}), config)
    (folder / "alone").mkdir()
    alone = shutil.copy(config, folder / "alone")
    with one_line_error(ConfigError, match="neither plant.yaml"):
        ErrorPredictor.build(controller, settings, str(alone))
