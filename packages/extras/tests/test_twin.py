"""The twin: its core, its fit, and a known robot found again."""

from __future__ import annotations

import os

import numpy as np
import pytest
from twin_parts import MOTORS, drawn_truth, fitted, in_terms_of, known_robot, record_of

from diffdrive_mpc import ConfigError, NotCompiledError, make_plant
from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.compiled import cache, compiler
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.core import library
from diffdrive_mpc.sim.plants import chassis
from diffdrive_mpc.sim.plants.drivetrain import CommandShaper, DelayLine, SpeedObserver, VelocityLoops
from diffdrive_mpc.sim.plants.open_loop import drive_open_loop, random_commands
from diffdrive_mpc.sim.plants.twin_parameters import load_firmware, load_twin_parameters
from diffdrive_mpc_extras.twin.fitting import told_apart
from diffdrive_mpc_extras.twin.free_run import FreeMotion, drive, most_telling, readings, stretch
from diffdrive_mpc_extras.twin.from_log import energy_note
from diffdrive_mpc_extras.twin.nominal import nominal_robot
from diffdrive_mpc_extras.twin.settings import twin_settings
from diffdrive_mpc_extras.twin.space import space_of
from oracle.drivetrain import Drivetrain

ROBOT, TWIN = load_robot(), load_twin_parameters()
STEP = ROBOT.sample_time / TWIN.substeps
PULSE = 2 * np.pi / ROBOT.encoder_pulses


@pytest.mark.parametrize("dead_time", [0.0, 0.04, 0.7])
def test_every_bit_of_the_drivetrain_is_that_of_the_oracle(dead_time: float) -> None:
    """Rounded product by product: neither compiler nor processor may make it another one."""
    twin = TWIN.model_copy(update={"link": TWIN.link.model_copy(update={"dead_time": dead_time})})
    rng = np.random.default_rng(0)
    phase = rng.random(4)
    oracle = Drivetrain(load_firmware(), twin, ROBOT, STEP, phase.tolist())
    line, shaper = DelayLine(dead_time), CommandShaper(load_firmware(), ROBOT, STEP)
    observer = SpeedObserver(twin.driver.observer_bandwidth, PULSE, STEP, phase)
    loops = VelocityLoops(twin.driver, twin.motor, PULSE, STEP)
    stall = TWIN.motor.stall_torque * np.array(TWIN.motor.spread)
    angles, limits = np.zeros(4), 0
    for k in range(3000):
        start, end = k * STEP, (k + 1) * STEP
        if k % 10 == 0:
            # Rest now and then, and commands at which the motors give all they have.
            command = rng.choice([0.0, 1.0, 8.0]) * rng.uniform(-1, 1, 2)
            line.send(start, command)
            oracle.send(start, command.tolist())
        if k % 500 == 0:
            loops.supply = oracle.supply = float(rng.uniform(0.5, 1.0))
        speeds = observer.speed + rng.normal(0, 0.3, 4)
        torques = loops.torque(shaper.set_points(line.mean(start, end)), observer.speed, speeds)
        assert torques.tolist() == oracle.torques(start, end, speeds.tolist())
        duty = (torques / stall + speeds / TWIN.motor.no_load_speed) / loops.supply
        limits += int(np.any(np.abs(duty) > 1 - 1e-9))
        angles = angles + STEP * 10 * torques
        oracle.observe(angles.tolist())
        assert observer.update(angles).tolist() == oracle.speed
    assert limits > 100


def test_more_commands_under_way_than_there_was_room_for_keep_their_order() -> None:
    line = DelayLine(1.0)
    for k in range(100):
        line.send(0.01 * k, np.array([float(k), -float(k)]))
        if k == 20:
            line.mean(0.0, 0.01)
    for k in range(99):
        begin = 1.0 + 0.01 * k
        np.testing.assert_allclose(line.mean(begin, begin + 0.01), [k, -k], atol=1e-9)


def _driven() -> tuple[np.ndarray, ...]:
    drive = drive_open_loop(make_plant("mujoco", seed=3), random_commands(3, smooth=False)[:150])
    return drive.true_pose, drive.true_twist, drive.wheel_speeds, drive.yaw_rate


def test_physics_called_through_python_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where MuJoCo's library is not found."""
    assert library.physics_step() is not None
    direct = _driven()
    monkeypatch.setattr(chassis, "physics_step", lambda: None)
    for one, other in zip(direct, _driven(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_without_a_compiler_the_wheel_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: object) -> None:
    monkeypatch.setattr(compiler, "_COMPILERS", ("no-such-compiler",))
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path))
    for cached in (library.load_twin, compiler.find_compiler):
        cached.cache_clear()
    try:
        with pytest.raises(
            NotCompiledError, match=r"drivetrain is not compiled: no C compiler.*install gcc, or .*wheel"
        ):
            make_plant("mujoco")
    finally:
        for cached in (library.load_twin, compiler.find_compiler):
            cached.cache_clear()


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
