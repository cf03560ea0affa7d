"""Robots with independent physics follow a path as plants of the closed loop."""

import numpy as np
import pytest
from foreign_plants import FOREIGN

from diffdrive_mpc import Controller, load_config, load_trajectory, simulate

PATH = "{timing: smooth, segments: [{v: 0.3, omega: 0.5, duration: 1.0}]}"


@pytest.mark.parametrize("kind", FOREIGN)
def test_foreign_robot_follows_its_path_reproducibly(kind, tmp_path):
    (tmp_path / "path.yaml").write_text(PATH, encoding="utf-8")
    config = load_config("ssm")
    reference = load_trajectory(tmp_path / "path.yaml", config)
    first, repeated, noisy, different = (
        simulate(Controller(config), FOREIGN[kind](robot, seed), reference)
        for robot, seed in ((0, 1), (0, 1), (0, 2), (1, 1))
    )
    assert first.metrics.completed and np.abs(first.errors.lateral).max() < 0.05
    np.testing.assert_array_equal(first.true_pose, repeated.true_pose)
    assert not np.array_equal(first.true_pose, noisy.true_pose)
    assert not np.array_equal(first.true_pose, different.true_pose)
