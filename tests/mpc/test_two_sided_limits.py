"""Two-sided limits: forward and reverse, left and right, acceleration and braking."""

import pickle

import numpy as np
import pytest
import yaml

from diffdrive_mpc import Controller, Measurement, load_config, load_trajectory, make_plant, simulate
from diffdrive_mpc.bench.drive import plant_settings
from diffdrive_mpc.mpc.config.described import commented_yaml
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_commands
from diffdrive_mpc.mpc.trajectories.smooth_segments import time_smooth_path
from fuzz.controller import check_step

SIDES = {
    "limits.v": ("forward", "reverse"),
    "limits.omega": ("left", "right"),
    "limits.v_slew": ("accelerate", "brake"),
    "limits.omega_slew": ("accelerate", "brake"),
}
TIGHT = {"limits.v": 0.6, "limits.omega": 1.2, "limits.v_slew": 0.6, "limits.omega_slew": 2.5}
TWO_SIDED = {
    "limits.v": {"forward": 0.8, "reverse": 0.2},
    "limits.omega": {"left": 1.5, "right": 1.0},
    "limits.v_slew": {"accelerate": 1.0, "brake": 0.4},
    "limits.omega_slew": {"accelerate": 2.0, "brake": 5.0},
}


def test_scalar_and_two_sided_limits_are_unchanged_by_dumping_and_loading():
    config = load_config("ssm", TWO_SIDED)
    assert config.limits.v.sides == (0.8, 0.2)
    assert config.limits.v == load_config("ssm", {"limits.v": {"reverse": 0.2, "forward": 0.8}}).limits.v
    assert config.limits.v not in (0.2, 0.8)
    assert config.limits.v != load_config(config, {"limits.v.forward": 0.9}).limits.v
    assert yaml.safe_load(yaml.safe_dump(config.limits.v)) == {"forward": 0.8, "reverse": 0.2}
    assert load_config("ssm", {"limits.v": 0.6}).limits.v.sides == (0.6, 0.6)
    assert load_config("ssm", {"limits.v": {"forward": 0.6, "reverse": 0.6}}) == load_config("ssm", {"limits.v": 0.6})
    assert load_config(config, {"limits.v.reverse": 0.3}).limits.v.sides == (0.8, 0.3)
    assert load_config(load_config("ssm"), {"limits.v.reverse": 0.3}).limits.v.sides == (1.5, 0.3)
    assert load_config(yaml.safe_load(commented_yaml(config))) == config
    assert pickle.loads(pickle.dumps(config)) == config
    assert config.model_dump()["limits"]["omega_slew"] == {"accelerate": 2.0, "brake": 5.0}
    assert config.model_dump()["limits"]["v_braking"] == 2.0


@pytest.mark.parametrize("method", ["auto", "osqp", "daqp"])
def test_equal_sides_give_the_same_commands_as_a_scalar(method):
    runs = []
    for is_two_sided in (False, True):
        values = {key: dict.fromkeys(SIDES[key], value) if is_two_sided else value for key, value in TIGHT.items()}
        config = load_config("ssm", {**values, "solver.method": method, "horizon": 15})
        run = simulate(Controller(config), make_plant("model:ssm", seed=1), load_trajectory("k_turn", limits=config))
        runs.append(run.command)
    assert (np.abs(np.diff(runs[0], axis=0)) > 0.0).any()
    np.testing.assert_array_equal(*runs)


def random_slews(rng):
    """Return two-sided slew limits."""
    return {key: dict(zip(SIDES[key], rng.uniform(0.3, 3.0, 2), strict=True)) for key in SIDES if key.endswith("slew")}


def random_reference(rng):
    """Return a reference with steps between random twists within the ranges of `TWO_SIDED`."""
    segments = [
        Segment(v=rng.uniform(-0.19, 0.7), omega=rng.uniform(-0.9, 0.9), duration=rng.uniform(0.2, 0.8))
        for _ in range(8)
    ]
    return time_commands(segments, TrajectoryLimits.of_robot(), name="drawn")


@pytest.mark.parametrize("method", ["auto", "osqp", "daqp"])
def test_every_command_stays_inside_the_limits(method):
    """Random drives with changes of direction, failures, holds, and limits that are tightened during the drive."""
    signs, modes = set(), set()
    for seed in range(6):
        rng = np.random.default_rng(seed)
        config = load_config("ssm", TWO_SIDED | random_slews(rng) | {"solver.method": method, "horizon": 12})
        controller, plant = Controller(config), make_plant("model:ssm", seed=seed)
        controller.start(random_reference(rng), plant.time)
        last = np.zeros(2)
        for tick in range(220):
            measurement = plant.measure()
            if rng.random() < 0.01:
                controller.update(limits={"v.reverse": rng.uniform(0.05, 0.2), "omega.left": rng.uniform(0.5, 1.5)})
            if tick in range(120, 160) and seed == 0:
                measurement = Measurement()
            hold = Hold("pause") if tick in range(60, 75) and seed == 1 else None
            result = controller.step(plant.time, measurement, hold)
            check_step(result, controller.config, last, held=hold is not None)
            signs |= {tuple(np.sign(last * result.command))} if result.mode == "TRACKING" else set()
            modes.add(str(result.mode))
            last = result.command
            plant.advance(last)
    assert {sign[0] for sign in signs} >= {-1.0, 1.0} and {sign[1] for sign in signs} >= {-1.0, 1.0}
    assert {"TRACKING", "BRAKING"} <= modes


def test_command_that_crosses_zero_uses_the_rest_of_the_tick_to_accelerate():
    """The command brakes to zero in half of the tick and accelerates in the other half, without a sum of both rates."""
    config = load_config("ssm", {"limits.v_slew": {"accelerate": 4.0, "brake": 1.0}, "horizon": 15})
    controller, plant = Controller(config), make_plant("model:ssm", seed=0)
    controller.start(
        time_commands([Segment(v=-1.0, omega=0.0, duration=2.0)], TrajectoryLimits(2, 2, 99, 99), name="back"), 0.0
    )
    dt = config.sample_time
    controller.set_applied_commands([[0.5 * dt, 0.0]])
    command = controller.step(plant.time, plant.measure()).command
    assert command[0] == pytest.approx(-0.5 * dt * 4.0, abs=1e-12)


def test_reference_is_compared_with_the_limit_of_its_side():
    config = load_config("ssm", TWO_SIDED)
    controller = Controller(config)

    def reference(v, omega):
        return time_commands([Segment(v=v, omega=omega, duration=3.0)], TrajectoryLimits.of_robot(), name="constant")

    for v, omega in ((0.7, 0.0), (-0.19, 0.0), (0.1, 1.4), (0.1, -0.9)):
        controller.checked_reference(reference(v, omega))
    with pytest.raises(ValueError, match=r"v = 0.3 at .* more than limits.v.reverse = 0.2; slow"):
        controller.checked_reference(reference(-0.3, 0.0))
    with pytest.raises(ValueError, match=r"omega = 1.2 at .* more than limits.omega.right = 1; slow"):
        controller.checked_reference(reference(0.1, -1.2))


def test_result_of_a_late_robot_contains_the_active_limit():
    """The reverse speed is limited during the drive: the reference waits and catches up in its slow part."""
    segments = [Segment(v=v, omega=0.0, duration=duration) for v, duration in ((-0.3, 3.0), (0.1, 10.0))]
    reference = time_commands(segments, TrajectoryLimits.of_robot(), name="back and forth")
    controller, plant, states = Controller("ssm"), make_plant("model:ssm", seed=1), []
    controller.start(reference, plant.time)
    with pytest.warns(UserWarning, match=r"the robot will lag behind its reference: .* limits.v.reverse = 0.2"):
        controller.update(limits={"v.reverse": 0.2})
    while plant.time < 20.0:
        result = controller.step(plant.time, plant.measure())
        if not states or states[-1][0] != result.state:
            states.append((result.state, result.limited_by))
        plant.advance(result.command)
    assert states == [("TRACKING", ""), ("LATE", "limits.v.reverse"), ("TRACKING", ""), ("FINISHED", "")]


@pytest.mark.parametrize("model", ["kinematic", "mbm", "sm", "ssm"])
def test_shipped_models_are_never_late_on_the_shipped_paths(model):
    for name in ("circle", "square", "s", "cane"):
        assert "LATE" not in simulate(Controller(model), make_plant("mujoco", seed=1), load_trajectory(name)).states


@pytest.mark.parametrize(("track", "slew"), [(1.0, 0.9), (1.0, 1.1), (1.3, 0.9)])
def test_inner_wheel_is_not_reported_as_saturated_in_a_turn_at_full_slew(track, slew):
    """v responds later than omega: the inner wheel is temporarily slower than each command requires."""
    limits = {"v": 2.0, "predicted_v": 2.4, "omega": 2.5, "predicted_omega": 3.0, "wheel_speed": 3.2, "v_slew": slew}
    config = load_config(
        "ssm", {"wheels.track": track, "wheels.encoder_track": track} | {f"limits.{k}": v for k, v in limits.items()}
    )
    run = simulate(Controller(config), make_plant("model:ssm", seed=2), load_trajectory("figure8", timing="commanded"))
    assert not any("no faster" in message for message in run.messages)


def test_plant_settings_contain_the_larger_side():
    limits = {"limits": {"v": {"forward": 2.5, "reverse": 0.2}}}
    assert plant_settings(load_config("ssm", limits))["limits"].v == 2.5


def test_smooth_timing_respects_the_speed_of_each_direction_and_both_rates():
    config = load_config("ssm", TWO_SIDED)
    limits = TrajectoryLimits.of_controller(config.limits)
    segments = [Segment(v=0.8, omega=0.3, duration=4.0), Segment(v=-0.2, omega=0.1, duration=6.0)]
    trajectory = time_smooth_path(segments, limits, name="back and forth")
    assert limits.v_acceleration.sides == (0.5, 0.2)  # half of the slew is reserved for tracking
    times = np.linspace(0.0, trajectory.duration, 4000)
    v = trajectory.sample(times).twist[:, 0]
    assert v.max() == pytest.approx(0.8, rel=1e-3) and v.min() == pytest.approx(-0.2, rel=1e-3)
    acceleration = np.diff(np.abs(v)) / np.diff(times)
    assert acceleration.max() == pytest.approx(0.5, rel=0.02) and acceleration.min() == pytest.approx(-0.2, rel=0.02)
    controller = Controller(config)
    assert controller.find_shortfall(controller.checked_reference(trajectory)) is None


@pytest.mark.parametrize(
    ("base", "limits"),
    [
        ("twist_range: {v: {forward: 1.5, reverse: 0.2}}", {"limits.v": {"forward": 1.5, "reverse": 0.2}}),
        (
            "twist_slew: {v: {accelerate: 1.0, brake: 0.4}, omega: 6.0}",
            {"limits.v_slew": {"accelerate": 1.0, "brake": 0.4}},
        ),
    ],
)
def test_base_with_two_sided_limits_has_similar_errors_as_the_default_base(tmp_path, base, limits):
    (tmp_path / "robot.yaml").write_text(f"description: a robot\nbase: {{{base}}}\n")
    config = load_config("ssm", limits)
    reference = load_trajectory("k_turn", limits=config, timing="smooth")
    errors = [
        simulate(Controller(settings), make_plant(plant, seed=0), reference).metrics.position_rmse_m
        for plant, settings in ((f"mujoco:{tmp_path / 'robot.yaml'}", config), ("mujoco", load_config("ssm")))
    ]
    assert errors[0] < 1.2 * errors[1]


def test_state_late_ends_once_the_robot_is_on_time() -> None:
    run = simulate(Controller("ssm"), make_plant("model:ssm+0.25", seed=3), load_trajectory("circle"))
    late_ticks = [k for k, state in enumerate(run.states) if state == "LATE"]
    assert late_ticks and late_ticks[-1] < 100
