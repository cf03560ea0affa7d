"""What the configuration of an identified robot says of horizon and noise: against step responses and drawn noise."""

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_mpc import VelocityModel, load_model
from diffdrive_mpc.models.identification.deliver.configuration import choose_pace, settling_time
from diffdrive_mpc.models.identification.fit.noise import sensor_noise
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.mpc.config.schema import ControllerConfig, Estimator

SETTINGS = identification_settings()


def lag_of(slow, quick=0.05, dead_time=(0.0, 0.0)):
    rates = np.array([1 / slow, 1 / quick])
    return VelocityModel("lag", "sm", np.diag(-rates), np.diag(rates), np.eye(2), np.array(dead_time))


@pytest.mark.parametrize("name", ["sm", "mbm", "ssm"])
def test_settling_is_that_of_the_step_response(name):
    model = load_model(name)
    late = 0.0
    for row in range(2):
        system = control.ss(model.A, model.B[:, [row]], model.C[[row]], 0)
        time, answer = control.step_response(system, T=np.linspace(0, 3, 6001))
        (off,) = np.nonzero(np.abs(answer - answer[-1]) > SETTINGS.settled * abs(answer[-1]))
        late = max(late, time[off[-1]] + model.dead_time[row])
    assert settling_time(model) == pytest.approx(late, abs=0.02)


@given(st.floats(0.02, 3.0), st.floats(0.0, 0.5))
def test_a_lag_is_answered_after_three_time_constants(lag, dead_time):
    found = settling_time(lag_of(lag, quick=lag / 2, dead_time=(dead_time, 0.0)))
    assert found == pytest.approx(dead_time - lag * np.log(SETTINGS.settled), rel=0.03)


@settings(max_examples=50)
@given(st.floats(0.01, 5.0), st.floats(0.001, 0.1))
def test_the_horizon_sees_the_answer_and_has_few_steps(lag, dt):
    pace = choose_pace(lag_of(lag), dt)
    assert SETTINGS.least_steps <= pace.horizon <= SETTINGS.most_steps
    assert pace.horizon * pace.sample_time >= SETTINGS.look_ahead * pace.settling * (1 - 1e-9)
    assert pace.sample_time == pytest.approx(pace.every * dt)
    if pace.every > 1:  # no more seldom than it must be
        assert SETTINGS.look_ahead * pace.settling > SETTINGS.most_steps * (pace.every - 1) * dt * (1 - 1e-6)


@pytest.mark.parametrize("outliers", [0.0, 0.01])
def test_noise_is_found_under_motion_plateaus_and_outliers(outliers):
    rng = np.random.default_rng(3)
    time = 0.02 * np.arange(5000)
    slow = np.column_stack((0.5 * np.sin(time), np.cos(0.7 * time)))
    twist = slow + rng.normal(size=slow.shape) * [0.03, 0.2]
    yaw_rate = slow[:, 1] + 0.05 * rng.normal(size=time.size)
    fresh = rng.random(time.size) < 0.7
    spoilt = rng.random(time.size) < outliers
    twist[spoilt] += 5.0
    found = sensor_noise([Record("a", 0.0, 0.02, slow, twist=twist, yaw_rate=yaw_rate, fresh_twist=fresh)])
    # A spike spoils three differences of a hundred, of which nine tenths count.
    assert found["wheel_speed_noise"] == pytest.approx(0.03, rel=0.1)
    assert found["wheel_yaw_rate_noise"] == pytest.approx(0.2, rel=0.1)
    assert found["yaw_rate_noise"] == pytest.approx(0.05, rel=0.1)
    assert "position_noise" not in found


def test_the_least_noises_are_those_of_the_shipped_configuration():
    usual = Estimator()
    assert SETTINGS.least_noise == {name: getattr(usual, name) for name in SETTINGS.least_noise}
    assert set(SETTINGS.least_noise) == {
        name for name in Estimator.model_fields if name.endswith("_noise") and "input" not in name
    }


def test_the_lengths_are_those_of_the_shipped_configuration():
    config = ControllerConfig()
    for key, length in SETTINGS.lengths.items():
        group, _, name = key.partition(".")
        assert getattr(getattr(config, group), name) == length
