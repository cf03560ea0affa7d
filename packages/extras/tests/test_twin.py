"""Twin: parameters, free runs, identifiability, and the fit of known robots."""

import json

import numpy as np
import pytest
import yaml

from commands import call, refusal
from diffdrive_mpc import ConfigError
from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.checked_yaml import merge_mappings
from diffdrive_mpc.models.identification.effects.free_run import sensor_experiments
from diffdrive_mpc.models.identification.from_logs import identify_data
from diffdrive_mpc.models.identification.log_data import LogData, divide
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.models.output_error.experiment import SampledExperiment, join_experiments
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.sim.plants.make import make_plant
from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant
from diffdrive_mpc.sim.plants.simulated_robot import SimulatedRobot, load_simulated_robot
from diffdrive_mpc_extras.twin.fitting import fit_twin, identifiable_parameters
from diffdrive_mpc_extras.twin.free_run import FreeMotion, cut_stretch, drive, most_active_windows, sensor_readings
from diffdrive_mpc_extras.twin.held_out import model_with_sensors
from diffdrive_mpc_extras.twin.nominal import nominal_robot
from diffdrive_mpc_extras.twin.problem import TwinProblem
from diffdrive_mpc_extras.twin.settings import twin_settings
from diffdrive_mpc_extras.twin.space import space_of
from studies.open_loop import drive_open_loop, random_commands

MOTORS = """\
description: data sheet of the motors
robot: {encoder_pulses: 537.7}
twin:
  chassis: {body_size: [0.30, 0.24, 0.10]}
  motor: {stall_torque: 2.38, no_load_speed: 32.67, rotor_inertia: 0.0026}
  driver: {proportional_gain: 0.2, integral_gain: 3.0}
"""


def draw_parameters(seed):
    """Draw friction, dead time, lags, gain, tracks and mass of a plant [SI units]."""
    stream = np.random.default_rng(seed)

    def factor(spread):
        return float(np.exp(stream.normal(0.0, spread)))

    return {
        "mass": 6.85 * factor(0.3),
        "dead_time": float(stream.uniform(0.01, 0.09)),
        "gain_v": factor(0.05),
        "lag_v": 0.1 * factor(0.4),
        "lag_omega": 0.05 * factor(0.4),
        "track": 0.39 * factor(0.15),
        "friction": 0.7 * factor(0.3),
        "wheel_base": 0.16 * factor(0.25),
    }


def build_robot(truth):
    changes = {
        "robot": {"mass": truth["mass"]},
        "twin": {"link": {"dead_time": truth["dead_time"]}, "chassis": {"wheel_base": truth["wheel_base"]}},
        "firmware": {name: truth[name] for name in ("gain_v", "lag_v", "lag_omega", "track")},
        "friction": truth["friction"],
    }
    return SimulatedRobot.model_validate(merge_mappings(load_simulated_robot("heavy").model_dump(), changes))


def simulate_record(robot, seed, seconds):
    """Simulate an open-loop drive with the default sensors."""
    plant = MujocoPlant(
        robot.friction, robot.sensors, seed, robot=robot.robot, twin=robot.twin, firmware=robot.firmware
    )
    drive = drive_open_loop(plant, random_commands(seed, smooth=False, duration=seconds))
    sides = np.column_stack([drive.wheel_speeds[:, [0, 2]].mean(axis=1), drive.wheel_speeds[:, [1, 3]].mean(axis=1)])
    return Record(
        "drive",
        0.0,
        plant.sample_time,
        drive.command,
        twist=drive.wheel_twist,
        yaw_rate=drive.yaw_rate,
        wheels=sides,
        wheel_speeds=drive.wheel_speeds,
    )


def fit_record(record, file, seconds):
    """Fit the first 60 % of a record."""
    train, held_out = map(tuple, divide([record], 0.6))
    data = LogData(train, held_out, ("drive",), "the rest", "gyro", (), ())
    runs = join_experiments(sensor_experiments(train))
    model = model_with_sensors(identify_data(data, STRUCTURES["sm"], "drive").content, runs)
    nominal = nominal_robot("drive", train, file)
    space = space_of(nominal, model.effects, has_gyro=True, has_encoder_lag=False)
    return fit_twin(TwinProblem(space, most_active_windows(runs, model.model.dc_gain, seconds)), model.start(nominal))


def in_fit_units(fit, truth):
    """Return the true values in the units of the fit's parameters."""
    robot = fit.space.nominal.robot
    return truth | {
        "mass": truth["mass"] / robot.robot.mass,
        "wheel_base": truth["wheel_base"] / robot.twin.chassis.wheel_base,
        "track": truth["track"] / fit.space.nominal.track_of_encoders,
    }


def rolling_record(radius, track, count=60):
    """Build a record of wheels that follow their commands exactly."""
    commands = np.tile([1.0, 0.4], (count, 1))
    wheels = np.column_stack([1.0 - 0.2 * track, 1.0 + 0.2 * track]) / radius
    return Record("r", 0.0, 0.05, commands, twist=commands, yaw_rate=commands[:, 1], wheels=np.tile(wheels, (count, 1)))


def test_values_and_deviations_are_inverse():
    nominal = nominal_robot("r", [rolling_record(0.1, 0.4)])
    space = space_of(nominal, BaseEffects(), has_gyro=True, has_encoder_lag=True)
    z = np.random.default_rng(0).uniform(-0.5, 0.5, len(space.names))
    low, high = space.bounds
    z = np.clip(z, 0.9 * low, 0.9 * high)
    np.testing.assert_allclose(space.deviations(space.values(z)), z, atol=1e-9)


@pytest.mark.parametrize(("mass", "radius", "track"), [(5.0, 0.05, 0.25), (600.0, 0.3, 1.1)])
def test_scaled_robot_follows_its_commands(mass, radius, track, tmp_path):
    """Robots of 5 kg and 600 kg, scaled from the robot of the papers, reach the commanded wheel twist."""
    (tmp_path / "robot.yaml").write_text(f"robot: {{mass: {mass}}}")
    nominal = nominal_robot("r", [rolling_record(radius, track)], tmp_path / "robot.yaml")
    assert nominal.stated == {"mass"}
    default, scaled = 2.38 / (6.85 * 0.0675), nominal.robot.twin.motor.stall_torque / (mass * radius)
    assert scaled == pytest.approx(default)
    space = space_of(nominal, BaseEffects(), has_gyro=True, has_encoder_lag=False)
    commands = np.tile([1.0, 0.4], (60, 1))
    run = SampledExperiment("r", 0.05, commands, np.zeros((60, 3)), np.ones((60, 3), dtype=bool))
    (motion,) = drive(space.robot(space.values(np.zeros(len(space.names)))), [cut_stretch(run, 0, 60, np.eye(2))])
    assert motion.wheels[-1, 0] == pytest.approx(1.0, rel=0.03)
    assert motion.twist()[-1, 2] > 0.1


def test_readings_have_delay_and_lag_of_the_encoders_and_offset_of_the_gyro():
    """Delay and lag shift a ramp by their sum; the gyro has no delay."""
    count, parts, step = 40, 4, 0.0125
    ramp = step * np.arange(parts * count)
    motion = FreeMotion(parts, np.column_stack([ramp, 2 * ramp]), np.column_stack([ramp, ramp, 3 * ramp]), 0)
    run = SampledExperiment(
        "r", parts * step, np.zeros((count, 2)), np.zeros((count, 3)), np.ones((count, 3), dtype=bool)
    )
    signals = sensor_readings(motion, run, {"encoders_delay": 0.03, "encoders_lag": 0.05, "gyro_offset": 0.2})
    time = parts * step * np.arange(count)[20:]
    np.testing.assert_allclose(signals[20:, 0], time - 0.08, atol=1e-3)
    np.testing.assert_allclose(signals[20:, 1], 2 * (time - 0.08), atol=2e-3)
    np.testing.assert_allclose(signals[20:, 2], 3 * time + 0.2, atol=1e-12)


def test_one_of_two_inseparable_parameters_is_identified():
    """The sum of two parameters determines each to 0.7 of its prior; with one fixed, the second is determined."""
    joint = np.array([1.0, 1.0, 0.0])
    single = np.array([0.0, 0.0, 1.0])
    information = np.eye(3) + 400.0 * np.outer(joint, joint) + 400.0 * np.outer(single, single)
    determined = identifiable_parameters(information, 0.7)
    assert sorted(determined[:2]) == [False, True]
    assert determined[2]
    assert identifiable_parameters(np.eye(3), 0.7) == [False, False, False]


def test_free_run_of_the_true_plant_reproduces_its_log():
    """A free run with the true parameters agrees with the log within the noise."""
    truth = draw_parameters(31)
    record = simulate_record(build_robot(truth), 31, 12.0)
    counts = np.ones((len(record.command), 3), dtype=bool)
    run = SampledExperiment("r", record.dt, record.command, np.column_stack([record.twist, record.yaw_rate]), counts)
    windows = most_active_windows([run], np.eye(2), twin_settings().window)
    (motion,) = drive(build_robot(truth), windows)
    error = (sensor_readings(motion, windows[0].experiment, {}) - windows[0].experiment.outputs).std(axis=0)
    assert error[0] < 0.02 * np.ptp(run.outputs[:, 0])
    assert error[2] < 0.03 * np.ptp(run.outputs[:, 2])


def test_log_without_wheel_speeds_requires_a_robot_file():
    record = Record("r", 0.0, 0.05, np.ones((20, 2)), twist=np.ones((20, 2)), yaw_rate=np.ones(20))
    with pytest.raises(ConfigError, match="use --robot with a file"):
        nominal_robot("r", [record])


SEEDS = (21, 22, 23, 24, 25, 26)
"""Seeds of the evaluation; seeds 11 to 14 were used to choose the settings."""


@pytest.mark.long
def test_parameters_are_inside_their_intervals(tmp_path):
    """At most 8 of 48 values are outside their 95 % interval; a correct fit exceeds this with probability 0.001."""
    file = tmp_path / "motors.yaml"
    file.write_text(MOTORS)
    outside = []
    for seed in SEEDS:
        truth = draw_parameters(seed)
        fit = fit_record(simulate_record(build_robot(truth), seed, 60.0), file, 30.0)
        expected = in_fit_units(fit, truth)
        for parameter in fit.parameters:
            if parameter.name in expected and not parameter.low <= expected[parameter.name] <= parameter.high:
                outside.append((seed, parameter.name, expected[parameter.name], parameter.low, parameter.high))
    assert len(outside) <= 8, outside


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "drive.csv"
    call("simulate", "--model", "sm", "--trajectory", "s", "--log", path)
    return path


@pytest.mark.long
@pytest.mark.usefixtures("quick_search")
def test_twin_command_writes_a_plant_and_a_report(log):
    out = log.parent / "twin"
    call("twin", log, "--seconds", 5, "--jobs", 1, "--out", out)
    content = json.loads((out / "twin.json").read_text())
    twin, model = (content[name]["fit_percent"] for name in ("twin", "model"))
    # The log was simulated with this plant: a velocity model cannot be much better.
    assert all(twin[channel] > model[channel] - 2.0 for channel in ("v", "omega"))
    result = {parameter["name"]: parameter for parameter in content["parameters"]}
    robot = load_simulated_robot(out / "plant.yaml")
    assert robot.friction == pytest.approx(result["friction"]["value"], rel=1e-6)
    assert robot.twin.link.dead_time == pytest.approx(result["dead_time"]["value"], rel=1e-6)
    assert result["dead_time"]["low"] <= 0.040 <= result["dead_time"]["high"]
    assert result["gain_v"]["low"] <= 1.0 <= result["gain_v"]["high"]
    provenance = yaml.safe_load((out / "plant.yaml").read_text())["firmware"]["provenance"]["parameters"]
    assert {name: parameter["told"] for name, parameter in provenance.items()} == {
        name: parameter["told"] for name, parameter in result.items()
    }
    report = (out / "twin.md").read_text()
    assert all(f"| {name} |" in report for name in result)
    assert (out / "figures" / "held_out.png").stat().st_size > 0
    make_plant(f"mujoco:{out / 'plant.yaml'}").advance((0.2, 0.0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seconds", "1"], "error: --seconds 1: use 5 or more"),
        (["--model", "lstm"], "error: model 'lstm' is nonlinear"),
    ],
)
def test_invalid_option_is_refused_in_one_line(log, options, message):
    assert message in refusal("twin", log, *options, "--out", log.parent / "none")
    assert not (log.parent / "none").exists()
