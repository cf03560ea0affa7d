"""Check of commands: valid runs pass, corrupted runs fail, and the check imports no code of the project."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from diffdrive_mpc.mpc import load_config
from diffdrive_mpc_extras.campaign import command_check
from diffdrive_mpc_extras.campaign.command_check import StatedLimits, Unsafe, check_commands, stated_limits

NO_VIOLATIONS = Unsafe(0, 0, 0, 0)
DT = 0.02
LIMITS = StatedLimits(maximum=(1.0, 2.0), slew=(2.0, 6.0), braking=(1.0, 3.0), max_pose_age=0.5, sample_time=DT)


def example_run(ticks: int = 200) -> tuple[np.ndarray, np.ndarray, list[str], np.ndarray]:
    """Build a drive that accelerates at the slew limit, drives, and then brakes at the braking limit, with poses."""
    time = DT * np.arange(ticks)
    v = np.minimum(2.0 * DT * np.arange(1, ticks + 1), 0.5)
    half = ticks // 2
    v[half:] = np.maximum(0.5 - 1.0 * DT * np.arange(1, ticks - half + 1), 0.0)
    modes = ["TRACKING"] * half + ["BRAKING" if speed > 0.0 else "STOPPED" for speed in v[half:]]
    return time, np.column_stack([v, np.zeros(ticks)]), modes, np.ones(ticks, dtype=bool)


def test_run_within_all_limits_passes() -> None:
    assert check_commands(*example_run(), LIMITS) == NO_VIOLATIONS


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_nonfinite_command_is_counted(value: float) -> None:
    time, command, modes, has_pose = example_run()
    command[20, 1] = value
    counts = check_commands(time, command, modes, has_pose, LIMITS)
    assert counts.not_finite == 1
    # The next command counts as a step from zero.
    assert counts.total == 2


def test_command_below_the_minimum_radius_is_counted() -> None:
    time, command, modes, has_pose = example_run()
    limits = replace(LIMITS, min_radius=2.0)
    command[:, 1] = np.where(np.arange(200) < 100, 0.5, 0.49) * command[:, 0]
    assert check_commands(time, command, modes, has_pose, limits) == NO_VIOLATIONS
    command[50, 1] += 1e-6
    assert check_commands(time, command, modes, has_pose, limits) == replace(NO_VIOLATIONS, turn=1)
    # A ramp at the braking limits of 1 m/s^2 and 3 rad/s^2 cannot keep a radius of 0.2 m, so braking is not counted.
    command[:, 1] = np.where(np.arange(200) < 90, 5.0, 5.1) * command[:, 0]
    small_radius = replace(LIMITS, min_radius=0.2, maximum=(9.0, 9.0), slew=(9.0, 99.0), braking=(1.0, 9.0))
    assert check_commands(time, command, modes, has_pose, replace(small_radius, min_radius=0.1)) == NO_VIOLATIONS
    assert check_commands(time, command, modes, has_pose, small_radius).turn == 110 - modes.count("STOPPED")
    assert check_commands(time, command, modes, has_pose, replace(small_radius, braking=(2.0, 9.0))).turn == 10


@pytest.mark.parametrize(("column", "value"), [(0, 1.001), (0, -1.001), (1, 2.001), (1, 2.1e9)])
def test_command_above_the_limit_is_counted(column: int, value: float) -> None:
    time, command, modes, has_pose = example_run()
    command[50, column] = value
    assert check_commands(time, command, modes, has_pose, LIMITS).limit == 1


def test_command_at_the_limit_passes() -> None:
    time, _, _, has_pose = example_run()
    command = np.column_stack(
        [np.minimum(2.0 * DT * np.arange(1, 201), 1.0), np.minimum(6.0 * DT * np.arange(1, 201), 2.0)]
    )
    assert check_commands(time, command, ["TRACKING"] * 200, has_pose, LIMITS) == NO_VIOLATIONS


@pytest.mark.parametrize("mode", ["TRACKING", "REUSED_PLAN"])
def test_step_above_the_slew_limit_is_counted(mode: str) -> None:
    time, command, modes, has_pose = example_run()
    command[40:60, 1] = 6.0 * DT * 1.01
    modes[40:61] = [mode] * 21
    # One violation at the rise and one at the fall.
    assert check_commands(time, command, modes, has_pose, LIMITS) == Unsafe(0, 0, 2, 0)


def test_braking_has_a_separate_limit_and_must_not_accelerate() -> None:
    time, command, modes, has_pose = example_run()
    command[105:, 0] -= 1.0 * DT * 0.5
    command[command < 0.0] = 0.0
    assert check_commands(time, command, modes, has_pose, LIMITS).slew == 1
    time, command, modes, has_pose = example_run()
    command[110:, 0] = command[109, 0] + 0.001
    modes[110:] = ["BRAKING"] * 90
    assert check_commands(time, command, modes, has_pose, LIMITS).slew == 1
    # A change of sign is a violation even if each step is within the braking limit.
    command[110:, 0] = command[109, 0] - 1.0 * DT * np.arange(1, 91)
    assert check_commands(time, command, modes, has_pose, LIMITS).slew > 40


def test_stopped_controller_may_step_to_zero_but_not_move() -> None:
    time, command, modes, has_pose = example_run()
    command[100:], modes[100:] = 0.0, ["STOPPED"] * 100
    assert check_commands(time, command, modes, has_pose, LIMITS) == NO_VIOLATIONS
    command[150, 0] = 0.001
    assert check_commands(time, command, modes, has_pose, LIMITS).slew == 1


def test_unknown_mode_is_counted_as_a_slew_violation() -> None:
    time, command, modes, has_pose = example_run()
    modes[30] = "HURRYING"
    assert check_commands(time, command, modes, has_pose, LIMITS).slew == 1


def test_motion_after_a_loss_of_poses_is_counted() -> None:
    time, command, modes, has_pose = example_run(400)
    has_pose[100:] = False
    # The commands continue unchanged.
    command[:] = [0.5, 0.0]
    command[:, 0] = np.minimum(2.0 * DT * np.arange(1, 401), 0.5)
    modes[:] = ["TRACKING"] * 400
    counts = check_commands(time, command, modes, has_pose, LIMITS)
    tolerance = round((LIMITS.max_pose_age + DT) / DT)
    assert counts == Unsafe(0, 0, 0, 400 - 100 - tolerance)
    start = 99 + tolerance + 1
    command[start:, 0] = np.maximum(0.5 - 1.0 * DT * np.arange(1, 400 - start + 1), 0.0)
    modes[start:] = ["BRAKING" if speed > 0.0 else "STOPPED" for speed in command[start:, 0]]
    assert check_commands(time, command, modes, has_pose, LIMITS) == NO_VIOLATIONS
    command[-1, 0] = 0.001
    assert check_commands(time, command, modes, has_pose, LIMITS).motion == 1


def test_motion_before_the_first_pose_is_counted() -> None:
    time, command, modes, has_pose = example_run()
    has_pose[:10] = False
    assert check_commands(time, command, modes, has_pose, LIMITS).motion == 10


def test_limits_come_from_the_file_and_the_overrides(tmp_path: Path) -> None:
    config = tmp_path / "config.yaml"
    config.write_text(
        "model: ssm\nlimits:\n  v: 0.9   # m/s\nfailure: {max_pose_age: 0.2, dead_reckoning: 0.0}\n", encoding="utf-8"
    )
    limits = stated_limits(config, {"limits.omega_slew": 4.0, "horizon": 20})
    assert limits == StatedLimits((0.9, 2.0), (2.0, 4.0), (2.0, 6.0), 0.2, 0.0202, 0.0, (0.9, 2.0), (2.0, 4.0))


def test_both_sides_of_limits_are_checked() -> None:
    sides = {
        "limits.v": {"forward": 1.0, "reverse": 0.2},
        "limits.v_slew": {"accelerate": 1.0, "brake": 4.0},
    }
    limits = stated_limits(None, {**sides, "sample_time": 0.02})
    assert (limits.maximum, limits.reverse_maximum) == ((1.0, 2.0), (0.2, 2.0))
    modes = ["TRACKING"] * 4

    def unsafe(*v: float) -> tuple[int, int]:
        counts = check_commands(
            np.arange(len(v)) * 0.02, np.column_stack([v, np.zeros(len(v))]), modes, [True] * 4, limits
        )
        return counts.limit, counts.slew

    assert unsafe(0.02, 0.04, 0.0, -0.02) == (0, 0)
    assert unsafe(0.02, 0.0399, -0.0101, -0.02) == (0, 1)  # brakes in one half of the tick and accelerates in the other
    assert unsafe(0.02, 0.04, -0.0099, -0.029) == (0, 0)
    assert unsafe(0.03, 0.02, 0.0, 0.0) == (0, 1)
    assert unsafe(-0.21, -0.21, -0.21, -0.21) == (4, 1)


def test_stated_limits_are_the_defaults_of_the_configuration() -> None:
    config = load_config({"model": "ssm"})
    stated = yaml.safe_load(command_check.STATED.read_text(encoding="utf-8"))
    for group, values in stated.items():
        for key, value in values.items() if isinstance(values, dict) else ():
            assert getattr(getattr(config, group), key) == value, key
    assert config.sample_time == stated["sample_time"]


def test_command_check_imports_no_module_of_the_project() -> None:
    tree = ast.parse(Path(command_check.__file__).read_text(encoding="utf-8"))
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    names |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    packages = {name.partition(".")[0] for name in names}
    assert packages == {"__future__", "collections", "dataclasses", "pathlib", "typing", "numpy", "yaml"}
