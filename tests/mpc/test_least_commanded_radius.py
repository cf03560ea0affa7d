"""Commands that turn no tighter than a radius: whatever is asked, as far as range and slew allow."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_mpc import ConfigError, Controller, Measurement, Stamped, load_config, load_trajectory
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.segments import Segment, lay_segments
from diffdrive_mpc.mpc.trajectories.speed_check import sharper_than_commands
from diffdrive_mpc.sim import make_plant, simulate

DT = 0.0202
KEY = "limits.min_commanded_radius"
HELD = "the turn is held to limits.min_commanded_radius"


def excess(commands, radius):
    """By how much commands turn tighter than allowed [m/s]."""
    v, omega = np.abs(np.atleast_2d(commands)).T
    return omega * radius - v


def driven(config, reference, **plant):
    return simulate(Controller(config), make_plant(**plant), reference)


@st.composite
def paths(draw):
    """Forwards and backwards, with cusps and stops, as sharp as the robot turns at all."""
    parts = []
    for _ in range(draw(st.integers(1, 4))):
        v = draw(st.sampled_from([-1.0, 1.0])) * draw(st.floats(0.2, 0.8))
        omega = draw(st.sampled_from([-1.0, 0.0, 1.0])) * draw(st.floats(0.2, 1.4))
        parts.append(Segment(v=v, omega=omega, duration=draw(st.floats(0.5, 1.5))))
    return lay_segments(parts, TrajectoryLimits.of_robot(), name="drawn")


@settings(max_examples=40, deadline=None)
@given(
    path=paths(),
    radius=st.floats(0.1, 3.0),
    slew=st.tuples(st.floats(0.3, 3.0), st.floats(0.5, 8.0)),
    braking=st.tuples(st.floats(0.3, 3.0), st.floats(0.5, 8.0)),
    seed=st.integers(0, 2**31),
)
def test_every_command_keeps_range_slew_and_radius(path, radius, slew, braking, seed):
    """A robot that goes where it likes: poses wander, jump and stay away, and somebody has it stand meanwhile."""
    limits = dict(zip(("v_slew", "omega_slew", "v_braking", "omega_braking"), (*slew, *braking), strict=True))
    overrides = {KEY: radius, "horizon": 12} | {f"limits.{name}": value for name, value in limits.items()}
    controller, random = Controller(load_config("ssm", overrides)), np.random.default_rng(seed)
    controller.start(path, 0.0)
    most, last = np.array([controller.config.limits.v, controller.config.limits.omega]), np.zeros(2)
    aside = np.zeros(3)
    for k in range(200):
        t = k * DT
        aside = 0.97 * aside + random.normal(size=3) * [0.02, 0.02, 0.05]
        pose = Stamped(path.sample([t]).pose[0] + aside, t) if random.random() > 0.1 else None
        hold = Hold("asked to stand") if 120 <= k < 130 else None
        step = controller.step(t, Measurement(pose=pose), hold)
        brakes = step.mode in ("BRAKING", "FINISHED")
        rate = np.array(braking if brakes else slew)
        assert (np.abs(step.command) <= most + 1e-12).all()
        if step.mode != "STOPPED":
            assert (np.abs(step.command - last) <= rate * DT + 1e-9).all()
        # A ramp to zero is not held up: it keeps the radius where omega's is quick enough for it.
        if not brakes or radius * braking[1] >= braking[0]:
            assert excess(step.command, radius).max() <= max(1e-12, excess(last, radius).max())
        last = step.command


@pytest.mark.parametrize(("sent", "held"), [((0.0, 1.0), 0.0), ((0.2, 1.0), 0.2), ((-0.3, -1.2), 0.3)])
def test_a_turn_that_somebody_else_began_is_led_out_of_as_fast_as_slew_allows_without_speeding_up(sent, held):
    """The yaw rate gives way; the speed is not raised beyond what it was for the radius' sake."""
    config = load_config("ssm", {KEY: 2.0, "limits.omega_slew": 2.0})
    rest = lay_segments([Segment(v=0.0, omega=0.0, duration=5.0)], TrajectoryLimits.of_robot(), name="rest")
    controller = Controller(config)
    controller.start(rest, 0.0)
    controller.set_applied_commands([sent])
    before = np.array(sent)
    for k in range(40):
        command = controller.step(k * DT, Measurement(pose=Stamped(np.zeros(3), k * DT))).command
        if excess(before, 2.0) > 0 and excess(command, 2.0) > 1e-9:
            assert abs(command[1]) == pytest.approx(abs(before[1]) - 2.0 * DT)
        assert abs(command[0]) <= held + 0.02
        before = command
    assert excess(before, 2.0) <= 1e-9


def test_a_sharper_curve_is_cut_and_the_robot_returns_to_its_path():
    """A quarter turn of radius 0.5 m where commands may turn on 0.7 m."""
    reference = lay_segments(
        [Segment(v=0.5, omega=0.0, duration=3.0), Segment(v=0.5, omega=1.0, duration=np.pi / 2)]
        + [Segment(v=0.5, omega=0.0, duration=6.0)],
        TrajectoryLimits.of_robot(),
        name="corner",
    )
    config = load_config("ssm", {KEY: 0.7})
    said = sharper_than_commands(reference, config.limits, config.sample_time)
    assert "for 2.1 s it turns tighter than limits.min_commanded_radius = 0.7, down to 0.5" in said
    run = driven(config, reference, name="model:ssm", sensors="perfect")
    assert excess(run.command, 0.7).max() <= 1e-12
    off = np.hypot(*(run.true_pose - reference.sample(run.time).pose)[:, :2].T)
    messages = np.array([HELD in message for message in run.messages])
    corner = (run.time > 2.5) & (run.time < 5.5)
    assert off[corner].max() > 0.03
    assert messages[corner].any() and not messages[run.time < 2.0].any()
    # The clock of the reference waited meanwhile: beside the path it is back sooner than on time.
    aside = np.abs(run.true_pose[:, 0] - reference.sample([reference.duration]).pose[0, 0])
    assert aside[run.time > 8.0].max() < 0.01
    assert off[-1] < 0.01
    free = driven(load_config("ssm"), reference, name="model:ssm", sensors="perfect")
    assert excess(free.command, 0.7).max() > 0.1


@pytest.mark.parametrize("radius", [0.55, 0.65])
def test_cusps_are_driven_with_the_radius_kept_forwards_and_backwards(radius):
    """The turn in three moves has arcs of 0.6 m: as before where that is allowed, and not much worse where not."""
    reference = load_trajectory("k_turn")
    run = driven(load_config("ssm", {KEY: radius}), reference, name="mujoco", seed=3)
    assert excess(run.command, radius).max() <= 1e-12
    assert run.command[:, 0].min() < -0.3
    assert run.metrics.completed
    assert run.metrics.position_rmse_m < (0.02 if radius < 0.6 else 0.12)


def test_a_reference_that_turns_on_the_spot_is_refused_in_one_line():
    with pytest.raises(
        ValueError, match=r"^reference 'square': at 2\.\d+ s it turns on the spot by 1\.6 rad, which lim"
    ):
        Controller(load_config("ssm", {KEY: 1.0})).start(load_trajectory("square"), 0.0)


@pytest.mark.parametrize("name", ["min_commanded_radius", "min_turn_radius"])
def test_a_radius_changes_while_driving_but_is_neither_set_nor_unset(name):
    controller = Controller(load_config("ssm", {f"limits.{name}": 1.5}))
    assert controller.update(limits={name: 1.2}).limits.model_dump()[name] == 1.2
    with pytest.raises(ConfigError, match=f"limits.{name}: it can be changed while driving, but neither set nor unset"):
        Controller(load_config("ssm")).update(limits={name: 1.2})


@pytest.mark.parametrize("surface", ["default", "slippery"])
def test_a_drawn_run_with_noise_and_a_push_never_turns_tighter(surface):
    """On the physics, on a path that turns tighter for a tenth of its time and more."""
    reference = load_trajectory("spline-501")
    plant = {"name": "mujoco", "surface": surface, "scenario": "push", "seed": 60500}
    run = driven(load_config("ssm", {KEY: 0.8}), reference, **plant)
    assert excess(run.command, 0.8).max() <= 1e-12
    assert set(run.modes) <= {"TRACKING", "FINISHED"}
    assert run.metrics.lateral_rmse_m < 0.3
    free = driven(load_config("ssm"), reference, **plant)
    assert (excess(free.command, 0.8) > 0.01).mean() > 0.1
