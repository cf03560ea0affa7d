"""The shipped paths at the edge, driven on the MuJoCo robot by the predictive controller with the SSM."""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import controller_config, run_case

EDGE = ["fast_circle", "figure8", "slalom", "reverse_slalom", "k_turn", "spiral", "spline-0"]
WHEEL_SPEED = ("limits.wheel_speed", 1.53)


@pytest.mark.parametrize("name", EDGE)
def test_a_path_at_the_edge_is_driven_to_its_end(name: str) -> None:
    run = run_case(Case(trajectory=name))
    assert run.metrics.completed
    assert run.metrics.fallbacks == 0
    assert run.metrics.in_band_percent == 100.0
    assert run.metrics.position_rmse_m < 0.025


@pytest.mark.parametrize("overrides", [(), (WHEEL_SPEED,)])
def test_limits_bind_on_tight_for_a_third_of_the_time(overrides: tuple[tuple[str, object], ...]) -> None:
    run = run_case(Case(trajectory="tight", overrides=overrides))
    assert run.metrics.completed
    config = controller_config("ssm", overrides=overrides)
    limits = config.limits
    command = run.command[run.counted]
    change = np.abs(np.diff(command, axis=0, prepend=0.0)) / config.sample_time
    encoders = np.array([one.wheel_twist.value for one in run.measurements if one.wheel_twist is not None])
    rim = np.abs(encoders) @ (1.0, config.wheels.encoder_track / 2)
    at = {
        "command": (np.abs(command) >= np.array([limits.v, limits.omega]) - 1e-4).any(axis=1),
        "slew": (change >= 0.999 * np.array([limits.v_slew, limits.omega_slew])).any(axis=1),
        "wheels": rim[run.counted] >= 0.98 * limits.wheel_speed,
    }
    share = {name: rows.mean() for name, rows in at.items()}
    assert share["command"] > 0.05
    assert share["slew"] > 0.1
    # Within the command's shipped limits the wheels never reach theirs.
    assert (share["wheels"] > 0.05) == bool(overrides)
    assert 0.28 < (at["command"] | at["slew"] | at["wheels"]).mean() < (0.5 if overrides else 0.45)
