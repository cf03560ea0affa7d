"""Another reference in mid-drive: what was learned outlasts it, and the same one again changes nothing."""

import numpy as np
import pytest

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant
from diffdrive_mpc.mpc.trajectories.moved import MovedReference
from diffdrive_mpc.mpc.trajectories.native import NativeReference

SLIPPERY = {"surface": "slippery", "sensors": "default", "seed": 4}


def drive(each_second, seconds=8.0, t0_of=lambda reference, t: t, **options):
    """Commands, and distances from the path [m], where a planner speaks each second or not at all."""
    controller = Controller(load_config(overrides=options))
    reference, plant = load_trajectory("circle"), make_plant("mujoco", **SLIPPERY)
    plant.reset(reference.sample([0.0]).pose[0])
    controller.start(reference, plant.time)
    commands, errors, since = [], [], 0.0
    for k in range(round(seconds / plant.sample_time)):
        if each_second and k and plant.time - since >= 1.0:
            since = plant.time
            each_second(controller, reference, plant.time)
        expected = reference.sample([plant.time]).pose[0]
        errors.append(np.hypot(*(plant.true_pose[:2] - expected[:2])))
        step = controller.step(plant.time, plant.measure())
        commands.append(step.command.copy())
        plant.advance(step.command)
    return np.array(commands), np.array(errors)


def test_the_same_reference_again_changes_nothing():
    plain, _ = drive(None)
    again, _ = drive(lambda controller, reference, t: controller.switch_reference(reference, 0.0))
    assert np.array_equal(plain, again)


def test_what_was_learned_outlasts_a_new_path():
    """A start each second forgets the floor each second; going on does not."""
    _, plain = drive(None)
    _, goes_on = drive(lambda controller, reference, t: controller.switch_reference(reference, 0.0))
    _, anew = drive(lambda controller, reference, t: controller.start(reference, 0.0))
    late = slice(len(plain) // 2, None)
    rms = [np.sqrt(np.mean(errors[late] ** 2)) for errors in (plain, goes_on, anew)]
    assert rms[1] == rms[0]
    assert rms[2] > 1.5 * rms[1]


def test_another_reference_has_a_clock_of_its_own_and_can_be_finished():
    controller, first = Controller(load_config()), load_trajectory("s")
    pose = first.sample([0.0]).pose[0]
    plant = make_plant("model:ssm")
    plant.reset(pose)
    controller.start(first, plant.time)
    for _ in range(60):
        plant.advance(controller.step(plant.time, plant.measure()).command)
    here = plant.true_pose.copy()
    other = load_trajectory("cane")
    begin = other.sample([0.0]).pose[0]
    moved = MovedReference(other, here - begin) if np.allclose(begin, 0.0) else other
    controller.switch_reference(moved, plant.time)
    assert controller.reference is moved
    until = plant.time + other.duration + 4.0
    while plant.time < until:
        step = controller.step(plant.time, plant.measure())
        plant.advance(step.command)
    assert str(step.mode) == "FINISHED"


def test_what_cannot_be_gone_on_along_is_refused():
    controller, reference = Controller(load_config()), load_trajectory("circle")
    with pytest.raises(RuntimeError, match="call start"):
        controller.switch_reference(reference, 0.0)
    controller.start(reference, 0.0)
    with pytest.raises(ValueError, match="give its t0"):
        controller.switch_reference(load_trajectory("s"))
    with pytest.raises(ValueError, match="finite"):
        controller.switch_reference(load_trajectory("s"), np.nan)


def test_the_core_takes_no_reference_without_finite_times():
    """As an exported controller is given one: refused, and what was tracked before goes on."""
    tick, reference = Controller(load_config())._tick, NativeReference(load_trajectory("s"))
    endless = tick.ffi.new("ddmpc_reference *", reference.struct[0])
    endless.duration = np.inf
    assert not tick.lib.ddmpc_relay(tick.c, reference.struct, 0.0), "there is none to go on from"
    for refused in ((reference.struct, np.nan), (reference.struct, np.inf), (endless, 0.0)):
        assert not tick.lib.ddmpc_start(tick.c, *refused)
    assert tick.lib.ddmpc_start(tick.c, reference.struct, 0.0) == 1
    for refused in ((reference.struct, np.nan), (reference.struct, np.inf), (endless, 0.0)):
        assert not tick.lib.ddmpc_relay(tick.c, *refused)
    assert tick.lib.ddmpc_relay(tick.c, reference.struct, 1.0) == 1
