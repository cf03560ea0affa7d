"""Base effects: behaviour and estimation from drives."""

from dataclasses import replace

import control
import numpy as np
import pytest
from base_effect_parts import DT, ENCODER_TRACK, linear_model, record_of, step_commands, write_effects
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from identification_parts import differences

from diffdrive_mpc import integrate_pose
from diffdrive_mpc.models.base_effects import (
    BaseEffects,
    PoseMount,
    TwistSlew,
    Veer,
    WheelCommand,
    YawRelaxation,
    respond,
)
from diffdrive_mpc.models.identification.effects import identify_with_effects
from diffdrive_mpc.models.identification.effects.free_run import free_run, smooth_command, two_lags
from diffdrive_mpc.models.identification.effects.pose_sensor import pose_sensor
from diffdrive_mpc.models.identification.fit.fitting import explain_rejection, fit
from diffdrive_mpc.models.identification.log_data import LogData
from diffdrive_mpc.models.load import load_base_effects, load_model
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.output_error.held_out import blocks
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.models.structures.sm import identify_sm

TWISTS = arrays(float, (2,), elements=st.floats(-3, 3, allow_subnormal=False))
STEPS = WheelCommand(track=0.5, resolution=0.01, coasting_speed=0.08, top_speed=2.0)
LENGTHS = st.floats(-1, 1)


@given(TWISTS, TWISTS, st.floats(0.001, 0.5))
def test_slew_is_bounded_and_never_overshoots(start, command, dt):
    slew = TwistSlew(v=1.0, omega=3.0)
    next_twist = slew.step(start, command, dt)
    assert (np.abs(next_twist - start) <= np.array([1.0, 3.0]) * dt + 1e-12).all()
    assert (np.abs(command - next_twist) <= np.abs(command - start) + 1e-12).all()


@given(TWISTS)
def test_sides_and_twist_are_inverse(twist):
    np.testing.assert_allclose(STEPS.twist(STEPS.sides(twist)), twist, atol=1e-12)


@given(TWISTS)
def test_motor_commands_are_whole_steps_within_the_command(twist):
    commanded, sides = STEPS.sides(twist), STEPS.sides(STEPS.apply(twist))
    steps = sides[~STEPS.coasts(twist)] / STEPS.resolution
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert (np.abs(sides) <= 2.0 + 1e-9).all()
    rolling = ~STEPS.coasts(twist)
    assert (np.abs(sides[rolling]) <= np.abs(commanded[rolling]) + 1e-9).all()
    unsaturated = rolling & (np.abs(commanded) < 2.0)
    assert (np.abs(commanded[unsaturated] - sides[unsaturated]) < STEPS.resolution + 1e-9).all()


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
def test_side_speed_is_monotone_in_its_command(left, right, opposite):
    """Each side is monotone with the other fixed; coasting, which depends on the other side, is excluded."""
    no_coast = STEPS.model_copy(update={"coasting_speed": 0.0})
    low, high = sorted([left, right])
    slower, faster = (
        no_coast.sides(no_coast.apply(no_coast.twist(np.array([side, opposite]))))[0] for side in (low, high)
    )
    assert faster >= slower - 1e-9


@pytest.mark.parametrize(("opposite", "speed"), [(1.0, 0.08), (-1.0, -0.08), (0.05, 0.05)])
def test_side_with_a_command_below_one_step_coasts_with_the_other_side(opposite, speed):
    commanded = STEPS.apply(STEPS.twist(np.array([0.009, opposite])))
    np.testing.assert_allclose(STEPS.sides(commanded), [speed, opposite], atol=1e-9)


@given(TWISTS)
def test_slope_is_the_derivative_of_the_map_without_steps(twist):
    smooth = STEPS.model_copy(update={"resolution": 0.0})
    speeds = np.abs(smooth.sides(twist))
    assume(np.abs(speeds - 2.0).min() > 1e-3 and speeds.min() > 1e-3)
    np.testing.assert_allclose(smooth.slope(twist), differences(smooth.apply, twist, 1e-5), atol=1e-6)


@given(st.floats(-1, 1), st.floats(-3, 3), st.floats(0.001, 1.0), st.floats(0.005, 0.5))
def test_strain_is_bounded_and_the_heading_is_conserved(strain, rate, dt, angle):
    end, body = YawRelaxation(angle=angle).advance(strain, rate, dt)
    assert -1 <= end <= 1
    assert body * dt == pytest.approx(rate * dt - angle * (end - strain), abs=1e-12)
    assert abs(body) <= abs(rate) * (1 + 1e-9) + 1e-12


@given(st.floats(-1, 1), st.floats(-3, 3), st.floats(0.01, 1.0))
def test_two_half_steps_equal_one_full_step(strain, rate, dt):
    relaxation = YawRelaxation(angle=0.04)
    once, mean = relaxation.advance(strain, rate, dt)
    middle, first = relaxation.advance(strain, rate, dt / 2)
    twice, second = relaxation.advance(middle, rate, dt / 2)
    assert twice == pytest.approx(once, abs=1e-12)
    assert 0.5 * (first + second) == pytest.approx(mean, abs=1e-9)


def test_reversal_loses_twice_the_angle_and_a_pause_loses_none():
    relaxation = YawRelaxation(angle=0.035)
    dt = 0.01
    rates = np.concatenate([np.full(100, 0.8), np.zeros(50), np.full(100, 0.8), np.full(200, -0.8)])
    body = relaxation.follow(rates, dt, 1.0)
    np.testing.assert_allclose(body[:250], rates[:250], atol=1e-12)
    heading_loss = dt * np.sum(body[250:] - rates[250:])
    assert heading_loss == pytest.approx(2 * 0.035, rel=0.12)
    assert relaxation.gain(1.0, 0.8) == 1.0
    assert relaxation.gain(1.0, -0.8) == -1.0


@given(TWISTS, LENGTHS)
def test_veer_is_inverted(twist, yaw_per_metre):
    veer = Veer(yaw_per_metre=yaw_per_metre)
    np.testing.assert_allclose(veer.wheels(veer.body(twist)), twist, atol=1e-12)
    assert veer.body([2.0, 0.0])[1] == pytest.approx(2 * yaw_per_metre)


@given(arrays(float, (3,), elements=st.floats(-4, 4)), LENGTHS, LENGTHS, LENGTHS)
def test_pose_mount_is_inverted_and_rigid(pose, ahead, left, heading):
    mount = PoseMount(ahead=ahead, left=left, heading=heading)
    centre = mount.centre(pose)
    np.testing.assert_allclose(mount.sensor(centre), pose, atol=1e-12)
    assert np.hypot(*(centre - pose)[:2]) == pytest.approx(np.hypot(ahead, left), abs=1e-12)


TRUE_EFFECTS = BaseEffects.model_validate(
    {
        "twist_slew": {"v": 1.5, "omega": 2.5},
        "wheel_command": {"track": 0.54, "resolution": 0.02, "coasting_speed": 0.12},
        "yaw_relaxation": {"angle": 0.04},
        "veer": {"yaw_per_metre": -0.06},
    }
)
# Yaw ratio of the encoders at which the gains match the base's track: 0.95 * 0.54 = ratio * 0.57 * 0.5.
RATIO = 0.95 * TRUE_EFFECTS.wheel_command.track / (0.57 * ENCODER_TRACK)
EFFECT_VALUES = {"slew.v": 1.5, "slew.omega": 2.5, "wheels.coasting": 0.12, "relaxation": 0.04, "veer": -0.06}
GAINS = {"gain.v": 0.95, "gain.omega": 0.57, "lag.v": 1 / 14, "lag.omega": 1 / 20}
POINT = dict.fromkeys(("dead_time.v", "dead_time.omega", "encoders.delay", "gyro.offset"), 0.0) | GAINS | EFFECT_VALUES
POINT |= {"encoders.yaw_ratio": RATIO, "encoders.track": ENCODER_TRACK, "wheels.resolution": 0.02}


def experiment_at_rest(commands):
    readings = np.zeros((len(commands), 3))
    return SampledExperiment("at rest", DT, commands, readings, np.ones(readings.shape, dtype=bool))


def test_free_run_equals_the_response_of_the_model_file():
    commands = step_commands(3, 60.0)
    response = respond(linear_model(), TRUE_EFFECTS, commands, DT)
    expected = np.column_stack([response.wheels * [1.0, RATIO], response.body[:, 1]])
    np.testing.assert_allclose(free_run(POINT, experiment_at_rest(commands)), expected, atol=1e-9)


@given(st.floats(0.02, 1.0), st.floats(0.3, 2.4))
def test_two_lags_are_exact_for_a_zero_order_hold(lag, damping):
    drive = np.random.default_rng(0).normal(size=50)
    system = control.sample_system(control.tf([1], [lag**2, 2 * damping * lag, 1]), DT, method="zoh")
    expected = control.forced_response(system, inputs=drive, timepts=DT * np.arange(50)).outputs
    np.testing.assert_allclose(two_lags(drive, 0.0, lag, damping, DT), expected, atol=1e-6)


COMMANDS = st.lists(st.sampled_from([-1.0, -0.3, 0.0, 0.2, 1.0]), min_size=1, max_size=60)


@given(COMMANDS, st.floats(0.05, 5.0), st.floats(-2.0, 2.0))
def test_ramps_equal_single_steps(levels, limit, start):
    slew = TwistSlew(v=limit, omega=2 * limit)
    commands = np.column_stack([levels, levels[::-1]])
    last, expected = np.array([start, -start]), []
    for command in commands:
        last = slew.step(last, command, DT)
        expected.append(last)
    np.testing.assert_allclose(slew.follow(commands, DT, [start, -start]), expected, atol=1e-9)


@given(COMMANDS, st.floats(0.005, 0.3), st.floats(-1.0, 1.0))
def test_relaxation_over_a_run_equals_relaxation_sample_by_sample(rates, angle, strain):
    relaxation = YawRelaxation(angle=angle)
    expected, z = [], strain
    for k, rate in enumerate(rates):
        if k:
            z, _ = relaxation.advance(z, 0.5 * (rates[k - 1] + rate), DT)
        expected.append(abs(rate) * z)
    np.testing.assert_allclose(relaxation.follow(rates, DT, strain), expected, atol=1e-9)


@given(st.floats(-1.0, 1.0), st.floats(-3.0, 3.0))
def test_smoothed_commands_differ_from_rounded_commands_by_less_than_a_step(v, omega):
    base = WheelCommand(track=0.5, resolution=0.02)
    twist = np.array([v, omega])
    deviation = base.sides(smooth_command(base, twist)) - base.sides(base.apply(twist))
    assert np.abs(deviation).max() < base.resolution


def test_each_sample_is_held_out_once():
    experiments = [experiment_at_rest(np.zeros((count, 2))) for count in (300, 500, 200)]
    folds = blocks(experiments)
    samples = [(i, k) for _, block in folds for i, first, stop in block for k in range(first, stop)]
    assert sorted(samples) == [(i, k) for i, experiment in enumerate(experiments) for k in range(experiment.samples)]
    for training, block in folds:
        assert not {(i, k) for i, a, b in training for k in range(a, b)} & {
            (i, k) for i, a, b in block for k in range(a, b)
        }


@pytest.fixture(scope="module")
def fit_result():
    return identify_with_effects([record_of(TRUE_EFFECTS, 7, 150.0, yaw_ratio=RATIO)])


@pytest.mark.system
def test_every_effect_is_identified(fit_result):
    assert set(fit_result.effects) == {"twist slew", "steps and coasting of the wheels", "yaw relaxation", "veer"}


@pytest.mark.system
def test_effects_are_recovered_within_their_stated_uncertainty(fit_result):
    estimate = fit_result.identified.parameters
    truth = {"v.gain": 0.95, "omega.gain": 0.57, "v.natural_frequency": 14.0, "omega.natural_frequency": 20.0}
    truth |= {"encoders.delay": 0.05, "gyro.offset": 0.02, "wheels.track": 0.54} | EFFECT_VALUES
    scores = {name: (estimate.value(name) - value) / estimate.deviation(name) for name, value in truth.items()}
    assert max(map(abs, scores.values())) < 4, scores
    assert fit_result.point["wheels.resolution"] == pytest.approx(0.02)


@pytest.mark.system
def test_model_file_contains_the_estimates(fit_result):
    content = fit_result.identified.file("found", {"origin": "identified", "source": "a test"})
    assert content.base_effects.twist_slew.omega == pytest.approx(fit_result.point["slew.omega"], rel=1e-6)
    assert content.base_effects.pose_mount is None
    assert (fit_result.fit_percent([record_of(TRUE_EFFECTS, 8, 60.0, yaw_ratio=RATIO)]) > 93).all()


@pytest.mark.system
def test_no_effect_is_identified_for_a_base_without_effects():
    assert identify_with_effects([record_of(BaseEffects(), 7, 75.0)]).effects == ()


@pytest.mark.long
def test_limit_of_the_plain_model_is_preserved():
    record = record_of(BaseEffects(), 7, 75.0, clip=1.0)
    limits = identify_sm([record]).limits
    assert limits == {"omega": pytest.approx(1.0, abs=0.05)}
    fit_result = identify_with_effects([record], limits=limits).identified
    assert fit_result.limits == {"omega": pytest.approx(1.0, abs=0.03)}
    assert fit_result.parameters.deviation("omega.limit") < 0.05


@pytest.mark.system
def test_effects_are_accepted_only_if_they_predict_better_than_the_plain_model(fit_result):
    records = [record_of(TRUE_EFFECTS, 7, 150.0, yaw_ratio=RATIO)]
    plain = identify_sm(records, limits=False)
    assert explain_rejection(fit_result, plain, records) is None
    degraded = replace(
        fit_result, points=tuple({**point, "gain.omega": 0.5 * point["gain.omega"]} for point in fit_result.points)
    )
    assert "no better than the plain model" in explain_rejection(degraded, plain, records)


def test_position_and_delay_of_a_pose_sensor_are_estimated():
    record = record_of(BaseEffects(), 11, 120.0, noise=0.1, delay=0.0)
    mount, travel, delay_steps = PoseMount(ahead=0.2, left=-0.05, heading=0.03), 0.93, 3
    body = respond(linear_model(), BaseEffects(), record.command, DT).body * [travel, 1.0]
    pose = [np.zeros(3)]
    for v, omega in 0.5 * (body[1:] + body[:-1]):
        pose.append(integrate_pose(pose[-1], v, omega, DT))
    measured = mount.sensor(pose)
    measured = np.concatenate([np.repeat(measured[:1], delay_steps, axis=0), measured[:-delay_steps]])
    with_pose = replace(record, pose=measured, fresh_pose=None)
    estimate = pose_sensor([with_pose], {**POINT, "gyro.offset": 0.02})
    truth = {"pose.travel": travel, "mount.ahead": 0.2, "mount.left": -0.05, "mount.heading": 0.03}
    for name, value in truth.items():
        assert abs(estimate.value(name) - value) < max(4 * estimate.deviation(name), 2e-3), name
    assert estimate.value("pose.delay") == pytest.approx(delay_steps * DT, abs=0.2 * DT)


FAST_WHEELS = BaseEffects.model_validate({"wheel_command": {"track": 0.54, "top_speed": 0.7}})


@pytest.mark.long
@pytest.mark.parametrize(
    ("effects", "clip", "gyro", "track"),
    [(BaseEffects(), 1.0, True, False), (BaseEffects(), 1.0, False, True), (FAST_WHEELS, np.inf, False, True)],
    ids=["clips, gyro", "clips, track", "top speed, track"],
)
def test_effects_do_not_worsen_the_prediction_of_held_out_rows(effects, clip, gyro, track):
    """test_logs_real.py checks this on logs of real robots, in all combinations."""
    record = record_of(effects, 9, 120.0, clip=clip)
    record = record if gyro else replace(record, yaw_rate=None, fresh_yaw_rate=None)
    record = record if track else replace(record, wheels=None)
    yaw = "gyro" if gyro else "encoders"
    data = LogData((record.part(0, 1440),), (record.part(1440, 2400),), ("made up",), "", yaw, (), ())
    plain, fit_result = (fit(data, STRUCTURES["sm"], effects=on).validation.fit_percent for on in (False, True))
    assert (fit_result > plain - 1.0).all()
    assert (fit_result > 94.0).all()  # the effects of the robot are identified


@pytest.mark.long
def test_top_speed_determines_the_track_missing_in_a_log():
    fit_result = identify_with_effects([replace(record_of(FAST_WHEELS, 9, 120.0), wheels=None)]).identified.parameters
    for name, value in (("wheels.track", 0.54), ("wheels.top_speed", 0.7)):
        assert abs(fit_result.value(name) - value) < 4 * fit_result.deviation(name), name
        assert fit_result.deviation(name) < 0.05 * value


EFFECTS = {
    "twist_slew": {"v": 2.0, "omega": 2.0},
    "wheel_command": {"track": 0.512, "resolution": 0.01, "coasting_speed": 0.08},
    "yaw_relaxation": {"angle": 0.035},
    "veer": {"yaw_per_metre": -0.05},
    "pose_mount": {"ahead": 0.146, "left": 0.041, "heading": 0.025},
}


def test_file_contains_effects_next_to_an_unchanged_linear_model(tmp_path):
    path = write_effects(tmp_path / "base.yaml", EFFECTS)
    wheels = EFFECTS["wheel_command"] | {"top_speed": None}
    assert load_base_effects(path).model_dump() == EFFECTS | {"wheel_command": wheels, "twist_range": None}
    np.testing.assert_array_equal(load_model(path).A, load_model("sm").A)


def random_steps(seed, steps=12, length=40):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform([-0.8, -1.5], [0.8, 1.5], (steps, 2)), length, axis=0)


def test_response_without_effects_equals_the_linear_model():
    model, commands = load_model("sm"), random_steps(1)
    response = respond(model, BaseEffects(), commands, DT)
    np.testing.assert_allclose(response.wheels, model.discretise(DT).simulate(commands), atol=1e-9)
    np.testing.assert_array_equal(response.wheels, response.body)


def test_response_from_a_settled_start_is_constant():
    model, command = load_model("sm"), np.array([0.4, -0.7])
    effects = BaseEffects(twist_slew=TwistSlew(v=1, omega=1), yaw_relaxation=YawRelaxation(angle=0.03))
    response = respond(model, effects, np.tile(command, (50, 1)), DT, start=command)
    np.testing.assert_allclose(response.body, np.tile(model.dc_gain @ command, (50, 1)), atol=1e-9)


def test_settled_twist_is_changed_only_by_steps_and_veer():
    """Slew and relaxation decay; commands are rounded to whole steps, and the body veers."""
    model, effects = load_model("sm"), BaseEffects.model_validate(EFFECTS)
    command = np.array([0.5, -0.9])
    settled = respond(model, effects, np.tile(command, (400, 1)), DT)
    expected = model.dc_gain @ effects.wheel_command.apply(command)
    np.testing.assert_allclose(settled.wheels[-1], expected, atol=1e-6)
    np.testing.assert_allclose(settled.body[-1], [expected[0], expected[1] - 0.05 * expected[0]], atol=1e-6)


def test_commands_within_the_slew_limit_pass_unchanged():
    """A controller with a slew limit up to that of the base can omit the limit of the base from its model."""
    model = load_model("sm")
    commands = np.column_stack([0.4 * np.sin(0.5 * DT * np.arange(200)), 0.8 * np.sin(0.7 * DT * np.arange(200))])
    limited = respond(model, BaseEffects(twist_slew=TwistSlew(v=1.0, omega=2.5)), commands, DT)
    np.testing.assert_allclose(limited.wheels, respond(model, BaseEffects(), commands, DT).wheels, atol=1e-12)


def test_top_speed_reduces_both_channels():
    """A saturated wheel drives the body slower and turns it less, as in a fast turn."""
    effects = BaseEffects(wheel_command=WheelCommand(track=0.5, top_speed=1.0), veer=Veer(yaw_per_metre=0.0))
    model = load_model("sm")
    settled = respond(model, effects, np.tile([0.9, 1.0], (200, 1)), DT).body[-1]
    np.testing.assert_allclose(settled, model.dc_gain @ [0.825, 0.7], rtol=1e-4)
