"""Written configuration of the controller: values are positive and safe for any result of the identification."""

from dataclasses import replace

import control
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_mpc import VelocityModel, load_model
from diffdrive_mpc.models.base_effects import BaseEffects, respond
from diffdrive_mpc.models.identification.deliver.configuration import choose_pace, configure, settling_time
from diffdrive_mpc.models.identification.fit.noise import sensor_noise
from diffdrive_mpc.models.identification.fit.slip import slip_prior
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.logs.geometry import WheelGeometry
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.structures.model_file import SmFile
from diffdrive_mpc.models.structures.sm import identify_sm
from diffdrive_mpc.models.velocity_model import CHANNELS
from diffdrive_mpc.mpc.config.rooms import merge_sections

CHANNEL = {"gain": 0.9, "natural_frequency": 10.0, "damping": 1.2}
WHEELS = {"track": 0.5, "top_speed": 0.4}
COMMANDS = np.repeat([[0.5, -1.0], [-0.3, 0.4]], 30, axis=0)
TRAIN = [Record("drive", 0.0, 0.05, COMMANDS, twist=COMMANDS, yaw_rate=COMMANDS[:, 1])]
GEOMETRY = WheelGeometry(0.1, 0.4)


def model_with(slew=None, deviation=0.1, limits=None, effects=None):
    names = ("slew.v", "slew.omega") if slew else ("v.gain",)
    values = np.array(slew or [0.9])
    slews = dict(zip(CHANNELS, slew or (), strict=False))
    effects = (effects or {}) | {"twist_range": limits or {}, "twist_slew": slews}
    return IdentifiedModel(
        schema=SmFile,
        content={"channels": {"v": CHANNEL, "omega": CHANNEL}, "base_effects": effects},
        parameters=ParameterEstimate(names, values, np.diag(np.full(len(values), deviation**2))),
        offset=np.zeros(2),
        yaw="gyro",
        method="made up",
        fits=(),
        warnings=(),
    )


def written(result, geometry=GEOMETRY, train=TRAIN):
    return configure("robot", result, train[:1], geometry, slip_prior(train), validation=train[1:]).mapping()


def limits(result, train=TRAIN):
    return written(result, train=train)["limits"]


def test_slew_is_two_deviations_below_the_slew_of_the_base():
    assert limits(model_with(slew=(1.5, 3.0)))["v_slew"] == pytest.approx(1.3)
    assert limits(model_with(slew=(1.5, 3.0)))["omega_slew"] == pytest.approx(2.8)
    result = limits(model_with(slew=(9.0, 9.0)))  # no more than the default
    assert (result["v_slew"], result["omega_slew"]) == (2.0, 6.0)
    assert "v_slew" not in limits(model_with())


@given(st.floats(1e-3, 50.0), st.one_of(st.floats(0.0, 1e6), st.just(np.inf), st.just(np.nan)))
def test_uncertain_slew_is_positive(slew, deviation):
    """Two deviations below a slew of 1.0 +- 0.6 m/s^2 would be -0.2."""
    result = limits(model_with(slew=(slew, slew), deviation=deviation))
    for name in ("v_slew", "omega_slew"):
        assert result[name] >= 0.499 * min(slew, 2.0)
        assert result[name] <= 1.001 * slew


def test_limits_are_taken_from_the_log_or_from_the_base():
    result = limits(model_with(limits={"omega": 0.8}), [replace(TRAIN[0], command=0.4 * COMMANDS), *TRAIN])
    assert (result["v"], result["omega"]) == (0.5, 0.8)
    assert (result["predicted_v"], result["predicted_omega"]) == pytest.approx((0.55, 0.88))


def test_wheel_speed_limit_covers_the_observed_wheel_speeds():
    assert limits(model_with(limits={"v": 0.5}))["wheel_speed"] == pytest.approx(0.5 + 0.2 * 1.0)


def test_commands_that_the_wheels_do_not_reach_limit_the_wheel_speed():
    result = limits(model_with(), train=[replace(TRAIN[0], twist=0.7 * COMMANDS)])
    assert result["wheel_speed"] == pytest.approx(0.7 * (0.5 + 0.2 * 1.0))


def test_each_side_is_written_with_its_own_limit():
    result = limits(model_with(limits={"v": {"reverse": 0.2}, "omega": {"left": 0.3, "right": 0.6}}))
    assert result["v"] == {"forward": 0.5, "reverse": 0.2}
    assert result["omega"] == {"left": 0.3, "right": 0.6}


def test_saturation_of_the_motors_limits_the_wheel_speed():
    low = limits(model_with(effects={"wheel_command": WHEELS}))
    assert low["wheel_speed"] == pytest.approx(0.9 * 0.4)
    high = limits(model_with(effects={"wheel_command": WHEELS | {"top_speed": 5.0}}))
    assert high["wheel_speed"] == pytest.approx(1.1 * (0.5 + 0.25 * 1.0))


@pytest.mark.parametrize("geometry", [GEOMETRY, None])
@pytest.mark.parametrize("slew", [(1.5, 3.0), None])
def test_file_and_mapping_have_equal_values(slew, geometry):
    result = model_with(slew=slew, effects={"wheel_command": WHEELS})
    configuration = configure("robot", result, TRAIN, geometry, slip_prior(TRAIN))
    text = configuration.text()
    assert merge_sections(yaml.safe_load(text)) == configuration.mapping()
    assert configuration.mapping()["sample_time"] == 0.05
    assert ("does not determine v_slew" in text) == (slew is None)
    assert ("does not determine wheels.track" in text) == (geometry is None)
    if geometry:
        assert configuration.mapping()["wheels"] == {"track": 0.5, "encoder_track": 0.4}


def test_reentry_band_scales_with_the_robot_and_is_at_least_the_default():
    large = written(model_with(), WheelGeometry(0.2, 0.99))
    assert large["reentry"]["band"] == pytest.approx(3 * 0.08)
    assert large["failure"]["max_position_error"] == pytest.approx(3.0)
    assert "reentry" not in written(model_with(), WheelGeometry(0.02, 0.1))
    train = [Record("drive", 0.0, 0.05, 6 * COMMANDS, twist=6 * COMMANDS)]
    assert written(model_with(), None, train)["reentry"]["wait"] == pytest.approx(0.9 * 3 / 1.5 * 0.1)


SETTINGS = identification_settings()


def lag_of(slow, quick=0.05, dead_time=(0.0, 0.0)):
    rates = np.array([1 / slow, 1 / quick])
    return VelocityModel("lag", "sm", np.diag(-rates), np.diag(rates), np.eye(2), np.array(dead_time))


@pytest.mark.parametrize("name", ["sm", "mbm", "ssm"])
def test_settling_time_equals_that_of_the_step_response(name):
    model = load_model(name)
    expected = 0.0
    for row in range(2):
        system = control.ss(model.A, model.B[:, [row]], model.C[[row]], 0)
        time, response = control.step_response(system, T=np.linspace(0, 3, 6001))
        (outside,) = np.nonzero(np.abs(response - response[-1]) > SETTINGS.settling_tolerance * abs(response[-1]))
        expected = max(expected, time[outside[-1]] + model.dead_time[row])
    assert settling_time(model) == pytest.approx(expected, abs=0.02)


@settings(max_examples=50)
@given(st.floats(0.01, 5.0), st.floats(0.001, 0.1))
def test_horizon_covers_the_response_with_few_steps(lag, dt):
    pace = choose_pace(lag_of(lag), dt)
    assert SETTINGS.min_steps <= pace.horizon <= SETTINGS.max_steps
    assert pace.horizon * pace.sample_time >= SETTINGS.look_ahead * pace.settling * (1 - 1e-9)
    assert pace.sample_time == pytest.approx(pace.log_samples * dt)
    if pace.log_samples > 1:  # no longer than necessary
        assert SETTINGS.look_ahead * pace.settling > SETTINGS.max_steps * (pace.log_samples - 1) * dt * (1 - 1e-6)


@pytest.mark.parametrize("outliers", [0.0, 0.01])
def test_noise_is_estimated_despite_motion_plateaus_and_outliers(outliers):
    rng = np.random.default_rng(3)
    time = 0.02 * np.arange(5000)
    motion = np.column_stack((0.5 * np.sin(time), np.cos(0.7 * time)))
    twist = motion + rng.normal(size=motion.shape) * [0.03, 0.2]
    yaw_rate = motion[:, 1] + 0.05 * rng.normal(size=time.size)
    fresh = rng.random(time.size) < 0.7
    is_outlier = rng.random(time.size) < outliers
    twist[is_outlier] += 5.0
    result = sensor_noise([Record("a", 0.0, 0.02, motion, twist=twist, yaw_rate=yaw_rate, fresh_twist=fresh)])
    # One outlier in a hundred readings affects three differences in a hundred; the estimate uses nine tenths of them.
    expected = {"wheel_speed_noise": 0.03, "wheel_yaw_rate_noise": 0.2, "yaw_rate_noise": 0.05}
    assert result == pytest.approx(expected, rel=0.1)


@pytest.mark.long
def test_each_side_of_range_and_ramp_is_identified():
    """The base is slower in reverse and brakes harder than it accelerates; omega is not limited."""
    rng = np.random.default_rng(3)
    command = np.repeat(rng.uniform(-1.0, 1.0, (40, 2)), 40, axis=0)
    base = BaseEffects(twist_range={"v": {"reverse": 0.3}}, twist_slew={"v": {"accelerate": 0.8, "brake": 2.0}})
    twist = respond(lag_of(0.15), base, command, 0.02).body + rng.normal(0.0, 0.01, command.shape)
    identified_base = identify_sm([Record("drive", 0.0, 0.02, command, twist=twist, yaw_rate=twist[:, 1])])
    truth = {"v.reverse": 0.3, "v.accelerate": 0.8, "v.brake": 2.0}
    assert {*truth, "v.forward", "omega.left"} & {*identified_base.parameters.names} == {*truth}
    for name, value in truth.items():
        assert identified_base.parameters.value(name) == pytest.approx(value, rel=0.03)
    assert identified_base.base_effects.twist_slew.omega is None
