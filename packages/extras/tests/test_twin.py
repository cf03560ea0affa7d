"""The twin: its core, its fit, and a known robot found again."""

from __future__ import annotations

import os

import numpy as np
import pytest
from twin_parts import MOTORS, drawn_truth, fitted, in_terms_of, known_robot, record_of

from diffdrive_mpc import ConfigError
from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.plants.twin_parameters import load_twin_parameters
from diffdrive_mpc_extras.twin.fitting import told_apart
from diffdrive_mpc_extras.twin.free_run import FreeMotion, drive, most_telling, readings, stretch
from diffdrive_mpc_extras.twin.from_log import energy_note
from diffdrive_mpc_extras.twin.nominal import nominal_robot
from diffdrive_mpc_extras.twin.settings import twin_settings
from diffdrive_mpc_extras.twin.space import space_of

ROBOT, TWIN = load_robot(), load_twin_parameters()
STEP = ROBOT.sample_time / TWIN.substeps
PULSE = 2 * np.pi / ROBOT.encoder_pulses


def rolling_record(radius, track, count=60):
    """Wheels that do what they are told."""
    commands = np.tile([1.0, 0.4], (count, 1))
    wheels = np.column_stack([1.0 - 0.2 * track, 1.0 + 0.2 * track]) / radius
    return Record("r", 0.0, 0.05, commands, twist=commands, yaw_rate=commands[:, 1], wheels=np.tile(wheels, (count, 1)))


def test_values_and_deviations_are_inverse():
    nominal = nominal_robot("r", [rolling_record(0.1, 0.4)])
    space = space_of(nominal, BaseEffects(), gyro=True, lagging=True)
    z = np.random.default_rng(0).uniform(-0.5, 0.5, len(space.names))
    low, high = space.bounds
    z = np.clip(z, 0.9 * low, 0.9 * high)
    np.testing.assert_allclose(space.deviations(space.values(z)), z, atol=1e-9)


@pytest.mark.parametrize(("mass", "radius", "track"), [(5.0, 0.05, 0.25), (600.0, 0.3, 1.1)])
def test_a_robot_of_any_size_obeys(mass, radius, track, tmp_path):
    """Scaled from the papers' robot, 5 kg and 600 kg reach the twist that they are told, on their wheels."""
    (tmp_path / "robot.yaml").write_text(f"robot: {{mass: {mass}}}")
    nominal = nominal_robot("r", [rolling_record(radius, track)], tmp_path / "robot.yaml")
    assert nominal.stated == {"mass"}
    usual, scaled = 2.38 / (6.85 * 0.0675), nominal.robot.twin.motor.stall_torque / (mass * radius)
    assert scaled == pytest.approx(usual)
    space = space_of(nominal, BaseEffects(), gyro=True, lagging=False)
    commands = np.tile([1.0, 0.4], (60, 1))
    run = SampledExperiment("r", 0.05, commands, np.zeros((60, 3)), np.ones((60, 3), dtype=bool))
    (motion,) = drive(space.robot(space.values(np.zeros(len(space.names)))), [stretch(run, 0, 60, np.eye(2))])
    assert motion.wheels[-1, 0] == pytest.approx(1.0, rel=0.03)
    assert motion.twist()[-1, 2] > 0.1


def test_sensors_of_the_log_come_late_and_smoothed():
    """A ramp seen through delay and lag is the ramp, later by their sum; the gyro is prompt, and off by its offset."""
    count, parts, step = 40, 4, 0.0125
    ramp = step * np.arange(parts * count)
    motion = FreeMotion(parts, np.column_stack([ramp, 2 * ramp]), np.column_stack([ramp, ramp, 3 * ramp]), 0)
    run = SampledExperiment(
        "r", parts * step, np.zeros((count, 2)), np.zeros((count, 3)), np.ones((count, 3), dtype=bool)
    )
    seen = readings(motion, run, {"encoders_delay": 0.03, "encoders_lag": 0.05, "gyro_offset": 0.2})
    time = parts * step * np.arange(count)[20:]
    np.testing.assert_allclose(seen[20:, 0], time - 0.08, atol=1e-3)
    np.testing.assert_allclose(seen[20:, 1], 2 * (time - 0.08), atol=2e-3)
    np.testing.assert_allclose(seen[20:, 2], 3 * time + 0.2, atol=1e-12)


def test_of_two_that_act_together_one_is_told():
    """Readings that see the sum alone leave each at 0.7 of its prior; with one at its prior the other is known."""
    together = np.array([1.0, 1.0, 0.0])
    alone = np.array([0.0, 0.0, 1.0])
    information = np.eye(3) + 400.0 * np.outer(together, together) + 400.0 * np.outer(alone, alone)
    told = told_apart(information, 0.7)
    assert sorted(told[:2]) == [False, True]
    assert told[2]
    assert told_apart(np.eye(3), 0.7) == [False, False, False]


def test_the_true_plant_explains_its_log():
    """Driven by its log's commands with its own numbers, the plant reads what the log holds, to its noise."""
    truth = drawn_truth(31)
    record = record_of(known_robot(truth), 31, 12.0)
    counts = np.ones((len(record.command), 3), dtype=bool)
    run = SampledExperiment("r", record.dt, record.command, np.column_stack([record.twist, record.yaw_rate]), counts)
    along = most_telling([run], np.eye(2), twin_settings().window)
    (motion,) = drive(known_robot(truth), along)
    error = (readings(motion, along[0].experiment, {}) - along[0].experiment.outputs).std(axis=0)
    assert error[0] < 0.02 * np.ptp(run.outputs[:, 0])
    assert error[2] < 0.03 * np.ptp(run.outputs[:, 2])


def test_without_wheels_the_robot_must_be_told():
    bare = Record("r", 0.0, 0.05, np.ones((20, 2)), twist=np.ones((20, 2)), yaw_rate=np.ones(20))
    with pytest.raises(ConfigError, match="--robot a file with"):
        nominal_robot("r", [bare])


@pytest.mark.parametrize(
    ("battery", "why"),
    [(None, "the log held no currents"), (np.ones((30, 2)), "the currents of the log are not fitted")],
)
def test_energies_of_a_twin_carry_a_caveat(battery, why):
    record = Record("made up", 0.0, 0.05, np.zeros((30, 2)), twist=np.zeros((30, 2)), battery=battery)
    assert f"may be wrong several times over: {why};" in energy_note([record])


SEEDS = (21, 22, 23, 24, 25, 26)
"""Not among those that anything was chosen on (11 to 14)."""

if "DIFFDRIVE_MPC_ALL" in os.environ:

    def test_parameters_are_inside_their_intervals(tmp_path):
        """Of 95 % intervals, at most as many miss as chance allows once in a thousand (8 of 48, binomial)."""
        file = tmp_path / "motors.yaml"
        file.write_text(MOTORS)
        missed = []
        for seed in SEEDS:
            truth = drawn_truth(seed)
            fit = fitted(record_of(known_robot(truth), seed, 60.0), file, 30.0)
            expected = in_terms_of(fit, truth)
            for one in fit.told:
                if one.name in expected and not one.low <= expected[one.name] <= one.high:
                    missed.append((seed, one.name, expected[one.name], one.low, one.high))
        assert len(missed) <= 8, missed

else:

    @pytest.mark.skip(reason="four minutes: DIFFDRIVE_MPC_ALL=1")
    def test_parameters_are_inside_their_intervals():
        pass
