"""Direct calls of core functions that closed-loop drives do not test in isolation, compared with other formulas."""

import math

import numpy as np
import pytest
from side_by_side import InnerController

from diffdrive_mpc import Measurement, Stamped, load_config, load_trajectory, simulate

STEPS = 8


def limit_to_radius(target, last, step, max_command, radius):
    """Return the command (2,) nearest to `target` within range and slew, with the turn reduced as far as slew permits.

    `step` (2, 2) contains the maximum increase and decrease per channel, `max_command` (2, 2) the limits per direction.
    """
    ranges = []
    for command, (increase, decrease) in zip(last, step, strict=True):
        size = abs(command)
        min_size = size - decrease if size > decrease else -increase * (1 - size / decrease)
        ranges.append(sorted([math.copysign(1, command) * min_size, math.copysign(1, command) * (size + increase)]))
    low, high = np.transpose(ranges)
    upper, lower = np.clip(max_command[:, 0], low, None), np.clip(-max_command[:, 1], None, high)
    v, omega = np.clip(target, np.maximum(low, lower), np.minimum(high, upper))
    if radius * abs(omega) <= abs(v):
        return np.array([v, omega]), 0.0
    max_turn = abs(v) / radius
    nearest = np.clip(omega, -max_turn, max_turn)
    if abs(nearest - np.clip(nearest, low[1], high[1])) < 1e-15:
        return np.array([v, nearest]), abs(omega - nearest)
    turn = last[1] - np.sign(last[1]) * step[1, 1]
    # Even the fastest decrease of the turn is too slow: the speed must not increase.
    speed = min(radius * abs(turn), abs(last[0]), -lower[0] if last[0] < 0 else upper[0])
    is_reduced = speed > abs(v) or (v < 0) != (last[0] < 0)
    return np.array([np.copysign(speed, last[0]) if is_reduced else v, turn]), abs(omega - turn)


def test_reused_command_respects_range_slew_and_radius_and_reports_a_reduced_turn():
    """The command is from a random plan and follows a random last command."""
    inner = InnerController(horizon=STEPS, **{"limits.min_commanded_radius": 1.0})
    c, k, rng, reported = inner.c, inner.k, np.random.default_rng(0), 0
    for _ in range(400):
        radius, step = rng.uniform(0.2, 2.0), rng.uniform([[0.005], [0.01]], [[0.2], [0.4]], (2, 2))
        last, plan = rng.uniform([-1, -2], [1, 2]), rng.uniform([-1.2, -2.4], [1.2, 2.4], (STEPS, 2))
        max_command = rng.uniform([[0.3], [0.5]], [[1.5], [2.5]], (2, 2))
        command, reduction = limit_to_radius(plan[3], last, step, max_command, radius)
        k.slew, k.largest_command = step.ravel().tolist(), max_command.ravel().tolist()
        k.min_commanded_radius, c.last = radius, last.tolist()
        # Test both sides of the threshold for reporting.
        factor = rng.choice([0.999, 1.001])
        k.turn_held_from, k.max_reused_ticks = [reduction * factor, 1e3], 3
        c.plan_age, c.result.reasons = 2, 0
        c.last_plan[0 : 2 * STEPS] = plan.ravel().tolist()
        inner.lib.ddmpc_reuse(c)
        assert c.result.mode == inner.lib.DDMPC_REUSED_PLAN
        assert [c.result.command[0], c.result.command[1]] == pytest.approx(command, abs=1e-12)
        is_held = bool(c.result.reasons & inner.lib.DDMPC_TURN_HELD)
        assert is_held == (reduction > 0 and factor < 1)
        reported += is_held
    assert reported > 30


def direction(v, sample, end):
    """Return the direction (1 or -1) of the next motion of the reference up to `end`, or of its last motion."""
    speeds = [x for x in [*v[sample : end + 1], *v[: sample + 1][::-1], v[0]] if abs(x) > 1.0]
    return -1.0 if (speeds[0] if speeds else v[0]) < 0 else 1.0


def test_turn_limits_have_the_sign_of_the_reference_direction():
    """The reference moves back and forth with rests; rows that depend on the speed have the sign of its motion."""
    inner = InnerController(horizon=STEPS, **{"limits.min_turn_radius": 0.5, "limits.min_commanded_radius": 0.5})
    controller, c, rng = inner.controller, inner.c, np.random.default_rng(0)
    controller.start(load_trajectory("circle"), 0.0)
    assert controller.step(0.0, Measurement(pose=Stamped(np.zeros(3), 0.0))).mode == "TRACKING"
    samples, lag = inner.lib.ddmpc_samples(c), c.sizes.lag_v
    for _ in range(200):
        levels = rng.choice([-2.0, 0.0, 0.5, -0.5, 2.0], samples)
        speeds = np.repeat(levels, rng.integers(1, 2 * STEPS, samples))[:samples]
        inner.k.standing = 1.0
        c.reference_twist[0 : 2 * samples] = np.column_stack([speeds, 0 * speeds]).ravel().tolist()
        inner.lib.ddmpc_problem_limit(c)
        gradients = np.reshape(list(c.problem.soft_gradient[0 : 7 * c.sizes.soft * STEPS]), (-1, STEPS, 7))
        # Columns: pose (3), speed and yaw rate of the model, command (2); the first two turn limits refer to the body.
        for kinds, offset, end, column in ((slice(5, 7), 1, STEPS, 3), (slice(7, 9), lag, samples - 1, 5)):
            signs = [-direction(speeds, i + offset, end) for i in range(STEPS)]
            assert np.sign(gradients[kinds, :, column]).tolist() == [signs, signs], (speeds, kinds)


@pytest.mark.parametrize(
    ("t0", "duration"), [(math.nan, 5.0), (math.inf, 5.0), (0.0, math.nan), (0.0, math.inf), (0.0, -math.inf)]
)
def test_rejected_reference_changes_no_state(t0, duration):
    """The previous reference remains active after a failed start or switch; a switch needs a previous reference."""
    inner, idle = InnerController(horizon=STEPS), InnerController(horizon=STEPS)
    inner.controller.start(load_trajectory("circle"), 1.0)
    reference = inner.ffi.new("ddmpc_reference *", inner.c.reference)
    assert inner.lib.ddmpc_switch_reference(idle.c, reference, 0.0) == 0
    reference.duration = duration
    for start in (inner.lib.ddmpc_start, inner.lib.ddmpc_switch_reference):
        assert start(inner.c, reference, t0) == 0
        assert (inner.c.t0, inner.c.reference.duration) == (1.0, load_trajectory("circle").duration)
    reference.duration = 5.0
    assert inner.lib.ddmpc_start(inner.c, reference, 2.0) == 1
    assert (inner.c.t0, inner.c.reference.duration) == (2.0, 5.0)
    assert inner.lib.ddmpc_switch_reference(inner.c, reference, 3.0) == 1


def test_late_poses_of_the_time_before_a_drive_are_skipped_without_a_message():
    settings = {"sensors.pose.delay": 0.21, "estimator.history": 0.4, "failure.max_pose_age": 1.0}
    run = simulate(load_config("ssm", settings), "model:ssm", "circle")
    assert run.metrics.completed and not any("pose rejected" in message for message in run.messages)
