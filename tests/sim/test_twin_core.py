"""The drivetrain in C against its oracle in Python, and the ways to call the physics from it."""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_mpc import NotCompiledError, make_plant
from diffdrive_mpc.models.compiled import cache, compiler
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.core import library
from diffdrive_mpc.sim.plants import chassis
from diffdrive_mpc.sim.plants.drivetrain import CommandShaper, DelayLine, SpeedObserver, VelocityLoops
from diffdrive_mpc.sim.plants.open_loop import drive_open_loop, random_commands
from diffdrive_mpc.sim.plants.twin_parameters import load_firmware, load_twin_parameters
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
