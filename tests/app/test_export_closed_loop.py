"""The exported controller gives the commands of the Python one, in every mode."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from export_parts import differences, drive_both, export

from diffdrive_mpc import Measurement, NonlinearModel, Stamped, Term
from diffdrive_mpc.models.turn_costs import load_turn_costs
from diffdrive_mpc.mpc import Mode, load_trajectory
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.solver.report import SolverStatus

# Limits that the square's corners lean on.
TIGHT = {"limits.omega": 1.0, "limits.v": 0.52, "limits.v_slew": 1.0, "limits.omega_slew": 2.5}
# Two commands that differ by no more than this are the same one [m/s, rad/s].
DOUBLE = 1e-6


@pytest.fixture(scope="module")
def in_double(tmp_path_factory):
    return export(tmp_path_factory.mktemp("export") / "double", "square", "double", TIGHT, "-O0")


@pytest.fixture(scope="module")
def with_sanitizers(tmp_path_factory):
    """Stops at the first access out of bounds, undefined operation, or complaint; soft limits matter."""
    folder = tmp_path_factory.mktemp("export") / "sanitized"
    overrides = {"limits.wheel_speed": 0.58, "failure.resume": False, "failure.dead_reckoning": 0.0}
    return export(folder, "s", "double", overrides, "-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def test_hard_limits_in_double_precision(in_double):
    steps = drive_both(in_double, "square", TIGHT, 350, offset=(0.02, -0.03, 0.1))
    assert np.abs(differences(steps)).max() <= DOUBLE
    solved = np.array([theirs.iterations > 0 for _, theirs in steps])
    assert solved.mean() > 0.2  # constraints were active
    assert not solved.all()  # and were not
    assert all(ours.mode == theirs.mode == Mode.TRACKING for ours, theirs in steps)


def test_soft_limits_in_double_precision(with_sanitizers):
    steps = drive_both(with_sanitizers, "s", {"limits.wheel_speed": 0.58, "failure.resume": False}, 150)
    assert np.abs(differences(steps)).max() <= DOUBLE
    assert sum(theirs.soft_limits > 0 for _, theirs in steps) > 50


def track_both(folder, trajectory, overrides, ticks, *flags, precision="double", within=DOUBLE, offset=(0, 0, 0), **of):
    """Steps of an export and of Python's controller, which track, and differ by no more than `within`."""
    program = export(folder / precision, trajectory, precision, overrides, "-O0", *flags, **of)
    steps = drive_both(program, trajectory, overrides, ticks, offset=offset, **of)
    assert np.abs(differences(steps)).max() <= within
    assert all(ours.mode == theirs.mode == Mode.TRACKING for ours, theirs in steps)
    return steps


def test_single_precision(tmp_path):
    """Rounding only: both stop at the exact solution of the same program."""
    steps = track_both(tmp_path, "square", TIGHT, 350, precision="float", within=2e-4, offset=(0.02, -0.03, 0.1))
    assert sum(theirs.iterations > 0 for _, theirs in steps) > 50


def test_soft_limits_in_single_precision(tmp_path):
    limits = {"limits.wheel_speed": 0.55, "limits.predicted_omega": 0.49, "limits.corridor": 0.1}
    steps = track_both(tmp_path, "s", limits, 300, precision="float", within=2e-4)
    assert sum(theirs.soft_limits > 0 for _, theirs in steps) > 100


def test_a_solve_that_is_stopped_drives_as_in_python(tmp_path):
    limits = {"limits.wheel_speed": 0.58, "solver.active_set_iterations": 1}
    steps = track_both(tmp_path, "s", limits, 200)
    assert sum(ours.solver.status is SolverStatus.STOPPED for ours, _ in steps) > 20


def test_another_model_with_dead_time(tmp_path):
    """Eight states, a horizon of its own, and commands that are two and three samples on their way."""
    overrides = {"horizon": 12, "extra_dead_time.v": 0.05, "extra_dead_time.omega": 0.03}
    track_both(tmp_path, "s", overrides, 100, offset=(0.0, 0.04, 0.1), model="mbm")


def test_curved_slip_and_a_least_turn_radius_come_along(tmp_path):
    overrides = {"estimator.veer_uncertainty": 0.02, "estimator.yaw_coupling": 0.05, "limits.min_turn_radius": 0.95}
    overrides["limits.min_commanded_radius"] = 1.2
    steps = track_both(tmp_path, "s", overrides, 120, "-fsanitize=address,undefined", offset=(0.0, 0.04, 0.1))
    assert sum(theirs.soft_limits > 0 for _, theirs in steps) > 20
    commands = np.abs([theirs.command for _, theirs in steps])
    assert (1.2 * commands[:, 1] <= commands[:, 0] + 1e-12).all()
    assert np.isclose(1.2 * commands[:, 1], commands[:, 0]).sum() > 20


def test_energy_and_its_least_radius_come_along(tmp_path):
    overrides = {
        "energy.turn_costs": "fsu_bot-carpet",
        "energy.weight": 0.01,
        "energy.use_min_radius": True,
        "horizon": 12,
    }
    steps = track_both(tmp_path, "circle", overrides, 120, offset=(0.0, 0.03, 0.05))
    radius = load_turn_costs("fsu_bot-carpet").least_radius()
    commands = np.abs([theirs.command for _, theirs in steps])
    assert (radius * commands[:, 1] <= commands[:, 0] + 1e-12).all()
    assert np.isclose(radius * commands[:, 1], commands[:, 0]).any()


def test_to_the_end(in_double):
    """The square ends where it begins: the robot starts there, shortly before the end."""
    skipped = 856 * 0.0202

    def change(k, measurement, exported, reference):
        return skipped, later(measurement, skipped), None

    steps = drive_both(in_double, "square", TIGHT, 150, change=change)
    assert [ours.mode for ours, _ in steps] == [theirs.mode for _, theirs in steps]
    assert np.abs(differences(steps)).max() <= DOUBLE
    assert steps[0][1].mode == Mode.TRACKING
    assert steps[-1][1].mode == Mode.FINISHED


def later(measurement: Measurement, shift: float) -> Measurement:
    parts = {
        name: replace(stamped, time=stamped.time + shift)
        for name in ("pose", "wheel_twist", "yaw_rate")
        if (stamped := getattr(measurement, name)) is not None
    }
    return replace(measurement, **parts)


def events(k, measurement, exported, reference):
    """What goes wrong, one thing after the other."""
    shift, hold = 0.0, None
    if k < 3 or 30 <= k < 60:
        measurement = replace(measurement, pose=None)
    elif k == 80:
        measurement = Measurement(Stamped((np.nan, 0.0, 0.0), measurement.pose.time), measurement.wheel_twist)
    elif 90 <= k < 120:  # carried to another place
        pose = np.asarray(measurement.pose.value) + [0.4, 0.1, 0.0]
        measurement = replace(measurement, pose=replace(measurement.pose, value=pose))
    elif k == 125:
        shift = -1.0  # the clock runs backwards
    elif k == 130:
        shift = 5.0  # the clock leaps, for one tick
    elif k == 140:
        measurement = replace(measurement, sent=(0.1, -0.2))
    elif k == 141:
        measurement = replace(measurement, sent=(np.nan, 0.0))
    elif 150 <= k < 156:
        hold = Hold("the operator says so")
    elif k == 170:
        measurement = replace(measurement, yaw_rate=Stamped(50.0, measurement.yaw_rate.time))
    exported.spoiled_from = reference.spoiled_from = np.inf
    if 180 <= k < 190:  # no solve succeeds
        exported.spoiled_from = reference.spoiled_from = (k + 0.5) * 0.0202
    return shift, measurement, hold


def test_every_step_of_the_ladder(in_double):
    steps = drive_both(in_double, "square", TIGHT, 230, change=events)
    assert [ours.mode for ours, _ in steps] == [theirs.mode for _, theirs in steps]
    assert np.abs(differences(steps)).max() <= DOUBLE
    modes = [theirs.mode for _, theirs in steps]
    assert set(modes) == {Mode.TRACKING, Mode.REUSED_PLAN, Mode.BRAKING, Mode.STOPPED}
    assert modes[180:185] == [Mode.REUSED_PLAN] * 5
    assert modes[185] == Mode.BRAKING
    assert modes[-1] == Mode.TRACKING


def test_a_failure_latches_where_the_robot_must_not_resume(with_sanitizers):
    overrides = {"limits.wheel_speed": 0.58, "failure.resume": False, "failure.dead_reckoning": 0.0}
    steps = drive_both(with_sanitizers, "s", overrides, 100, change=events)
    assert [ours.mode for ours, _ in steps] == [theirs.mode for _, theirs in steps]
    assert np.abs(differences(steps)).max() <= DOUBLE
    assert steps[-1][1].mode == Mode.STOPPED


def test_ticks_too_soon_and_pauses(in_double):
    def change(k, measurement, exported, reference):
        shift = -0.6 * 0.0202 if k == 20 else 0.0  # too soon after the tick before
        shift += 3.0 if k >= 40 else 0.0  # a pause
        return shift, later(measurement, 3.0) if k >= 40 else measurement, None

    steps = drive_both(in_double, "square", TIGHT, 60, change=change)
    assert [ours.mode for ours, _ in steps] == [theirs.mode for _, theirs in steps]
    assert np.abs(differences(steps)).max() <= DOUBLE
    assert {theirs.mode for _, theirs in steps[40:]} >= {Mode.STOPPED}


def test_ticks_at_any_time(in_double):
    """The trajectory is exact between samples, too."""
    rng = np.random.default_rng(0)

    def change(k, measurement, exported, reference):
        return rng.uniform(0.0, 0.005), measurement, None

    steps = drive_both(in_double, "square", TIGHT, 200, change=change)
    assert [ours.mode for ours, _ in steps] == [theirs.mode for _, theirs in steps]
    assert np.abs(differences(steps)).max() <= DOUBLE


def saturating_lag() -> NonlinearModel:
    """A lag of 0.1 s in both channels, whose acceleration saturates; the older command of the window acts."""
    x, window, dt = ca.SX.sym("x", 2), ca.SX.sym("window", 4), 0.0202
    most = ca.DM([1.5, 6.0])
    after = x + dt * most * ca.tanh((window[:2] - x) / (0.1 * most))
    step = ca.Function("step", [x, window], [after], ["x", "window"], ["after"])
    return NonlinearModel("lag", step, ca.Function("output", [x], [x], ["x"], ["y"]), dt)


def terms_of_the_user(point) -> tuple[Term, ...]:
    """A residual that does not like to turn, and a soft limit that keeps away from a point."""
    pose, twist, parameters = ca.SX.sym("pose", 3), ca.SX.sym("twist", 2), ca.SX.sym("parameters", 3)
    calm = ca.Function("calm", [twist], [2 * twist[1]], ["twist"], ["value"])
    distance = ca.sqrt((pose[0] - parameters[0]) ** 2 + (pose[1] - parameters[1]) ** 2 + 1e-4) - parameters[2]
    away = ca.Function("away", [pose, parameters], [distance], ["pose", "parameters"], ["value"])
    return (
        Term("calm", calm),
        Term("away", away, "soft", lower=[0.0], defaults=[*point, 0.2]),
    )


@pytest.mark.parametrize(("precision", "within"), [("double", DOUBLE), ("float", 2e-4)])
def test_functions_of_the_user(tmp_path, precision, within):
    """A nonlinear model and two terms: the same C as Python's."""
    given = {
        "model": saturating_lag(),
        "terms": terms_of_the_user(load_trajectory("circle").sample([2.5]).pose[0, :2]),
    }
    steps = track_both(
        tmp_path, "circle", {}, 200, precision=precision, within=within, offset=(0.0, 0.03, 0.0), **given
    )
    assert sum(theirs.soft_limits > 0 for _, theirs in steps) > 10


@pytest.mark.parametrize(
    ("model", "precision", "within"),
    [
        ("lstm", "double", DOUBLE),
        ("lstm", "float", 2e-3),
        ("p2_experimental", "double", DOUBLE),
        ("p2_physical", "double", DOUBLE),
    ],
)
def test_networks_and_drives_come_along(tmp_path, model, precision, within):
    """A network's weights as tables; slope limits and, of the experimental drive, its threshold."""
    track_both(tmp_path, "circle", {}, 60, precision=precision, within=within, model=model)
