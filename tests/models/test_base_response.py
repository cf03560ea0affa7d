"""A model file carries what its base does around the linear dynamics, and a free run puts it all in a row."""

import numpy as np
import pytest
import yaml

from diffdrive_mpc.models.base_effects import BaseEffects, TwistSlew, Veer, WheelCommand, YawRelaxation, respond
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.load import PARAMETERS, load_base_effects, load_model

DT = 0.05
EFFECTS = {
    "twist_slew": {"v": 2.0, "omega": 2.0},
    "wheel_command": {"track": 0.512, "resolution": 0.01, "coasting_speed": 0.08},
    "yaw_relaxation": {"angle": 0.035},
    "veer": {"yaw_per_metre": -0.05},
    "pose_mount": {"ahead": 0.146, "left": 0.041, "heading": 0.025},
}


@pytest.fixture
def with_effects(tmp_path):
    def write(effects):
        data = yaml.safe_load((PARAMETERS / "sm.yaml").read_text())
        path = tmp_path / "base.yaml"
        path.write_text(yaml.safe_dump({**data, "base_effects": effects}))
        return path

    return write


def test_file_carries_effects_beside_an_unchanged_linear_model(with_effects):
    path = with_effects(EFFECTS)
    assert load_base_effects(path).model_dump() == EFFECTS | {
        "wheel_command": EFFECTS["wheel_command"] | {"top_speed": None}
    }
    np.testing.assert_array_equal(load_model(path).A, load_model("sm").A)


def test_shipped_models_have_no_effects():
    assert load_base_effects("ssm") == BaseEffects()


@pytest.mark.parametrize(
    ("effects", "words"),
    [
        ({"twist_slew": {"v": 0.0, "omega": 2.0}}, "base_effects.twist_slew.v"),
        ({"twist_slew": {"v": 1.0}}, "base_effects.twist_slew.omega' is missing"),
        ({"yaw_relaxatoin": {"angle": 0.03}}, "did you mean 'base_effects.yaw_relaxation'"),
        ({"wheel_command": {"track": 0.5, "resolution": 0.1, "top_speed": 0.05}}, "less than one step"),
        ({"yaw_relaxation": {"angle": float("inf")}}, "base_effects.yaw_relaxation.angle"),
    ],
)
def test_mistakes_are_named_in_one_line(with_effects, effects, words):
    with pytest.raises(ConfigError, match=words) as error:
        load_base_effects(with_effects(effects))
    assert "\n" not in str(error.value)


def random_steps(seed, steps=12, length=40):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform([-0.8, -1.5], [0.8, 1.5], (steps, 2)), length, axis=0)


def test_without_effects_it_is_the_linear_model():
    model, commands = load_model("sm"), random_steps(1)
    response = respond(model, BaseEffects(), commands, DT)
    np.testing.assert_allclose(response.wheels, model.discretise(DT).simulate(commands), atol=1e-9)
    np.testing.assert_array_equal(response.wheels, response.body)


def test_a_settled_start_stays_settled():
    model, command = load_model("sm"), np.array([0.4, -0.7])
    effects = BaseEffects(twist_slew=TwistSlew(v=1, omega=1), yaw_relaxation=YawRelaxation(angle=0.03))
    response = respond(model, effects, np.tile(command, (50, 1)), DT, start=command)
    np.testing.assert_allclose(response.body, np.tile(model.dc_gain @ command, (50, 1)), atol=1e-9)


def test_effects_leave_the_settled_twist_alone_but_for_steps_and_veer():
    """Slew and relaxation pass; what is asked for in whole steps arrives, and the body veers."""
    model, effects = load_model("sm"), BaseEffects.model_validate(EFFECTS)
    assert effects.wheel_command is not None
    command = np.array([0.5, -0.9])
    settled = respond(model, effects, np.tile(command, (400, 1)), DT)
    expected = model.dc_gain @ effects.wheel_command.apply(command)
    np.testing.assert_allclose(settled.wheels[-1], expected, atol=1e-6)
    np.testing.assert_allclose(settled.body[-1], [expected[0], expected[1] - 0.05 * expected[0]], atol=1e-6)


def test_commands_within_the_slew_limit_pass_unchanged():
    """Why the controller can leave the limit out of its model once its own limit is no wider."""
    model = load_model("sm")
    slow = np.column_stack([0.4 * np.sin(0.5 * DT * np.arange(200)), 0.8 * np.sin(0.7 * DT * np.arange(200))])
    limited = respond(model, BaseEffects(twist_slew=TwistSlew(v=1.0, omega=2.5)), slow, DT)
    np.testing.assert_allclose(limited.wheels, respond(model, BaseEffects(), slow, DT).wheels, atol=1e-12)


def test_a_reversal_costs_the_body_twice_the_angle():
    model = load_model("sm")
    commands = np.column_stack([np.zeros(200), np.repeat([1.0, -1.0], 100)])
    response = respond(model, BaseEffects(yaw_relaxation=YawRelaxation(angle=0.04)), commands, DT, start=(0.0, 1.0))
    turned = DT * (response.body - response.wheels)[:, 1]
    assert turned.sum() == pytest.approx(0.08, rel=0.05)


def test_same_commands_same_run():
    model, effects = load_model("sm"), BaseEffects.model_validate(EFFECTS)
    runs = [respond(model, effects, random_steps(3), DT).body for _ in range(2)]
    np.testing.assert_array_equal(*runs)


@pytest.mark.parametrize("commands", [np.zeros(4), np.full((3, 2), np.nan)])
def test_bad_commands_are_named(commands):
    with pytest.raises(ValueError, match="expected K rows"):
        respond(load_model("sm"), BaseEffects(), commands, DT)


def test_top_speed_takes_from_both_channels():
    """A wheel that saturates drives the body slower and turns it less, as on a fast turn."""
    effects = BaseEffects(wheel_command=WheelCommand(track=0.5, top_speed=1.0), veer=Veer(yaw_per_metre=0.0))
    model = load_model("sm")
    settled = respond(model, effects, np.tile([0.9, 1.0], (200, 1)), DT).body[-1]
    np.testing.assert_allclose(settled, model.dc_gain @ [0.825, 0.7], rtol=1e-4)
