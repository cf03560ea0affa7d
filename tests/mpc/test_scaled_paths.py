"""Paths for robots of other sizes and speeds: the same shape, within what the robot can do."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_mpc import ConfigError, VelocityModel, load_config, load_model, load_trajectory
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.mpc.trajectories.limits import load_settings
from diffdrive_mpc.mpc.trajectories.moved import scaled_to_robot

PATHS = ("circle", "square", "s", "cane", "figure8", "k_turn")
size = st.floats(0.1, 10.0)


@settings(max_examples=40, deadline=None)
@given(
    path=st.sampled_from(PATHS),
    values=st.fixed_dictionaries(
        {
            "limits.v": size,
            "limits.omega": size,
            "limits.wheel_speed": size,
            "limits.v_slew": size,
            "limits.omega_slew": size,
            "wheels.track": size,
            "wheels.encoder_track": size,
        }
    ),
    gains=st.tuples(st.floats(0.3, 2.0), st.floats(0.3, 2.0)),
    lag=st.floats(0.01, 3.0),
)
def test_any_robot_can_follow_and_the_shape_stays(path, values, gains, lag):
    config, share = load_config("sm", values), load_settings()
    rate = np.eye(2) / lag
    model = VelocityModel("lag", "sm", -rate, rate * gains, np.eye(2))
    scaled, usual = scaled_to_robot(path, config, model), load_trajectory(path, timing="stop")
    dt = scaled.duration / 4000
    twist = scaled.sample(np.arange(4001) * dt).twist
    command = np.abs(twist) / gains
    limits = config.limits
    assert command[:, 0].max() <= share.reach_share * limits.v * (1 + 1e-9)
    assert command[:, 1].max() <= share.reach_share * limits.omega * (1 + 1e-9)
    rim = command[:, 0] + 0.5 * config.wheels.track * command[:, 1]
    assert rim.max() <= share.reach_share * limits.wheel_speed * (1 + 1e-9)
    slope = np.abs(np.diff(command, axis=0)).max(axis=0) / dt
    assert slope[0] <= share.slew_share * limits.v_slew * (1 + 1e-6)
    assert slope[1] <= share.slew_share * limits.omega_slew * (1 + 1e-6)

    # What a robot with that lag is commanded to follow: the inverse of its model.
    ahead = command[:-1] + lag * np.abs(np.diff(command, axis=0)) / dt
    assert ahead[:, 0].max() <= limits.v
    assert ahead[:, 1].max() <= limits.omega

    length = config.wheels.encoder_track / load_robot().track
    end, shipped = (one.sample(np.array([one.duration])) for one in (scaled, usual))
    np.testing.assert_allclose(end.pose[0, :2], length * shipped.pose[0, :2], atol=1e-6 * length)
    np.testing.assert_allclose(end.pose[0, 2], shipped.pose[0, 2], atol=1e-6)
    np.testing.assert_allclose(end.arc_length, length * shipped.arc_length, rtol=1e-6)


def test_only_segments_can_be_scaled(tmp_path):
    path = tmp_path / "drawn.yaml"
    path.write_text("waypoints: [[0, 0], [1, 0], [2, 1]]\nspeed: 0.3\n")
    with pytest.raises(ConfigError, match="segments"):
        scaled_to_robot(path, load_config("sm"), load_model("sm"))
