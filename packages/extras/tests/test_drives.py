"""Drive models compared with hand-written loops, an ODE solver, finite differences and known parameters."""

from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from identification_parts import check_written, differences
from log_parts import drive, write_csv, write_mapping
from scipy.integrate import solve_ivp

from diffdrive_mpc import ConfigError, ModelError, identify, load_config, load_model, simulate
from diffdrive_mpc.models.checked_yaml import check, read_yaml
from diffdrive_mpc.models.load import model_path
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.sim import make_plant
from diffdrive_mpc_extras.drives.drive_model import Channel, DriveModel, PhysicalFile, drive_model, experimental_step
from diffdrive_mpc_extras.drives.finding import identify_drive
from diffdrive_mpc_extras.drives.fitting import fit_drive

DRIVES = ("p2_experimental", "p2_physical")
DT, REST_SPEED = 0.02, 0.005
PARAMETERS = {"gain": 1.1, "quicker": 1.5, "slower": 2.5, "lag": 0.08, "least": 0.05, "by_slope": 0.06}


def reversals() -> np.ndarray:
    """Return commands (K,) with slow and fast ramps through zero, steps, and a stop before a change of direction."""
    corners = [(0, 0.0), (50, 0.0), (100, 0.6), (200, 0.6), (350, -0.6), (420, -0.6), (440, 0.5), (500, 0.5)]
    corners += [(501, -0.4), (600, -0.4), (630, 0.0), (700, 0.0), (760, 0.3), (900, 0.3)]
    return np.interp(np.arange(900), *np.transpose(corners))


def simulate_by_hand(u: np.ndarray) -> np.ndarray:
    """Simulate speeds (K,) of the experimental model in plain Python, as described in the paper."""
    reference = speed = slope = direction = 0.0
    speeds = []
    for command in u:
        speeds.append(speed)
        change = command - reference
        mean_slope = 0.5 * (PARAMETERS["quicker"] + PARAMETERS["slower"])
        towards_zero = reference * change < 0
        max_change = DT * (
            mean_slope if reference == 0 or change == 0 else PARAMETERS["slower" if towards_zero else "quicker"]
        )
        change = min(max(change, -max_change), max_change)
        reference += change
        slope += (1 - np.exp(-DT / 0.1)) * (abs(change) / DT - slope)
        has_reversed = direction * reference < 0
        is_rising = slope > REST_SPEED / 0.1
        is_stuck = has_reversed and is_rising and abs(reference) < PARAMETERS["least"] + PARAMETERS["by_slope"] * slope
        loss = abs(direction) if is_stuck else 0.0
        speed += (1 - np.exp(-DT / PARAMETERS["lag"])) * (PARAMETERS["gain"] * reference * (1 - loss) - speed)
        direction *= np.exp(-DT / 10.0)
        if abs(speed) > REST_SPEED:
            direction = np.sign(speed)
    return np.array(speeds)


def run(*, sharp: bool) -> np.ndarray:
    step = experimental_step(Channel(DT, REST_SPEED), sharp=sharp)
    x, speeds = np.zeros(4), []
    for command in reversals():
        speeds.append(x[1])
        x = step(x, command, list(PARAMETERS.values())).full().ravel()
    return np.array(speeds)


def test_sharp_experimental_model_equals_the_hand_written_loop():
    assert np.abs(run(sharp=True) - simulate_by_hand(reversals())).max() < 1e-12


@pytest.mark.parametrize("name", DRIVES)
def test_gradients_equal_finite_differences(name):
    model = load_model(name)
    x, window = ca.SX.sym("x", model.order), ca.SX.sym("w", 2 * (model.memory + 1))
    stacked = ca.vertcat(x, window)
    jacobian = ca.Function("j", [x, window], [ca.jacobian(model.step(x, window), stacked)])
    rng = np.random.default_rng(3)
    for _ in range(20):
        point = np.concatenate([0.3 * rng.standard_normal(model.order), 0.5 * rng.standard_normal(window.numel())])
        numeric = differences(lambda x: model.step(x[: model.order], x[model.order :]).full(), point)
        exact = jacobian(point[: model.order], point[model.order :]).full()
        assert np.isfinite(exact).all()
        assert np.abs(exact - numeric).max() < 1e-5 * max(1.0, np.abs(exact).max())


def test_physical_model_solves_the_equations_of_both_wheels():
    """Compare with equations 14 to 17 in an ODE solver, with a PI controller and an actuator for each wheel."""
    file = check(PhysicalFile, read_yaml(model_path("p2_physical")), "p2_physical")
    c, d = file.chassis, file.wheel_drive
    forward = c.mass * c.wheel_radius**2 / 4
    turning = (c.yaw_inertia + c.mass * c.centre_ahead**2) * c.wheel_radius**2 / c.track**2
    inertia = np.array([[forward + turning, forward - turning], [forward - turning, forward + turning]])
    inertia += c.wheel_inertia * np.eye(2)
    dt, count = file.sample_time, 60
    switch_time = 20 * dt

    def command(t: float) -> np.ndarray:
        return np.array([0.3, 0.4]) if t < switch_time - 1e-9 else np.array([0.35, -0.2])

    def rates(t: float, x: np.ndarray, dead: np.ndarray) -> np.ndarray:
        # Right and left wheel: speed, torque, integral of the error.
        speed, torque, integral = x.reshape(3, 2)
        v, omega = (command(t - delay)[i] if t >= delay else 0.0 for i, delay in enumerate(dead))
        v, omega = v * file.v.gain, omega * file.omega.gain
        target = np.array([v + omega * c.track / 2, v - omega * c.track / 2]) / c.wheel_radius
        error = target - speed
        target_torque = d.proportional_gain * (error + integral / d.integral_time)
        acceleration = np.linalg.solve(inertia, torque - d.friction * speed)
        return np.concatenate([acceleration, (target_torque - torque) / d.actuator_lag, error])

    # The slope limits are so high that they do not act.
    steps = {"quicker": 1e6, "slower": 1e6}
    steep = file.model_copy(update={k: getattr(file, k).model_copy(update=steps) for k in ("v", "omega")})
    dead = [file.v.dead_samples, file.omega.dead_samples]
    model = drive_model("p", "drive_physical", dt, dead, [1e-3, 1e-3], steep.coefficients())
    simulated = model.simulate(np.array([command(k * dt + 1e-9) for k in range(count)]))
    # Integrate each interval between jumps separately, so that the solver cannot step over a jump.
    delays = dt * np.array(dead)
    edges = sorted({0.0, *delays, *(delays + switch_time), (count - 1) * dt})
    x, times, speeds = np.zeros(6), [], []

    for start, end in pairwise(edges):
        middle = 0.5 * (start + end)
        instants = [k * dt for k in range(count) if start - 1e-9 <= k * dt < end - 1e-9]
        options = {"t_eval": [*instants, end], "method": "Radau", "rtol": 1e-9, "atol": 1e-11}
        solution = solve_ivp(lambda t, x, m=middle: rates(m, x, delays), (start, end), x, **options)
        times += instants
        speeds += list(solution.y[:2, : len(instants)].T)
        x = solution.y[:, -1]
    right, left = np.array(speeds).T * c.wheel_radius
    expected = np.column_stack([(right + left) / 2, (right - left) / c.track])
    assert len(times) >= count - 1
    assert np.abs(simulated[: len(expected)] - expected).max() < 1e-6
    assert np.abs(expected).max() > 0.2


@pytest.mark.parametrize("name", DRIVES)
def test_plant_uses_the_sharp_step(name):
    model = load_model(name)
    plant = make_plant(f"model:{name}", surface="ideal", seed=1)
    x, past = np.zeros(model.order), np.zeros((model.memory, 2))
    for k in range(80):
        command = np.array([0.5, 0.4]) if k < 40 else np.array([-0.3, -0.5])
        plant.advance(command)
        window = np.vstack([past, command])
        x, past = model.sharp(x, window.ravel()).full().ravel(), window[1:]
    assert plant.true_twist[[0, 2]] == pytest.approx(model.output(x).full().ravel(), abs=1e-9)


def test_invalid_file_raises_a_one_line_error(tmp_path):
    path = tmp_path / "drive.yaml"
    path.write_text(model_path("p2_experimental").read_text().replace("lag:", "lagg:"), encoding="utf-8")
    with pytest.raises(ConfigError, match="unknown key 'v.lagg'; did you mean 'v.lag'"):
        load_model(path)


LOG_DT, LOG_REST_SPEED = 0.04, (0.005, 0.02)
DEAD_SAMPLES = (3, 2)
NO_LIMIT = 200.0
LIMITED = [np.array([0.95, 1.0, 1.6, 0.1, 0.0, 0.0]), np.array([0.8, 2.0, 3.0, 0.06, 0.0, 0.0])]
UNLIMITED = [np.array([0.95, NO_LIMIT, NO_LIMIT, 0.1, 0.0, 0.0]), np.array([0.8, NO_LIMIT, NO_LIMIT, 0.06, 0.0, 0.0])]


def drive_record(coefficients, seed, seconds=40.0, *, backwards=True):
    """Return a record with noisy readings of a sharp experimental drive; the commands change every 0.8 s."""
    rng = np.random.default_rng(seed)
    low = -1.0 if backwards else 0.3
    commands = np.repeat(rng.uniform(low, 1.0, (round(seconds / 0.8), 2)), round(0.8 / LOG_DT), axis=0)
    robot = drive_model("robot", "drive_experimental", LOG_DT, DEAD_SAMPLES, LOG_REST_SPEED, coefficients)
    x, window = np.zeros(robot.order), np.zeros((robot.memory + 1, 2))
    twist = np.empty_like(commands)
    for k, command in enumerate(commands):
        window = np.vstack([window[1:], command])
        twist[k] = x[[1, 5]]
        x = robot.sharp(x, window.ravel()).full().ravel()
    noisy = twist + rng.normal(0, [0.005, 0.01], twist.shape)
    return Record(f"drive {seed}", 0.0, LOG_DT, commands, twist=noisy, yaw_rate=noisy[:, 1] + 0.01)


def identify_example(coefficients, kind="drive_experimental", **options):
    records = [drive_record(coefficients, 1, **options)]
    return identify_drive(fit_drive(kind, records), records)


def test_active_slope_limits_are_identified_within_their_uncertainty():
    finding = identify_example(LIMITED)
    assert not {"v.quicker", "v.slower", "omega.quicker", "omega.slower"} & set(finding.prior_names)
    assert {"v.threshold", "v.threshold_by_slope"} <= set(finding.prior_names), "this robot never stands still"
    # The smoothing lowers the limit at its corner, which adds a systematic error.
    for row, channel in enumerate(("v", "omega")):
        for name, truth in zip(("gain", "quicker", "slower"), LIMITED[row], strict=False):
            assert finding.estimate.value(f"{channel}.{name}") == pytest.approx(truth, rel=0.12), name
    assert finding.fit.dead_samples == DEAD_SAMPLES
    assert finding.estimate.deviation("v.gain") < 0.02


def test_parameters_undetermined_by_a_log_have_their_prior_value():
    """Use a log without active slope limits and without changes of direction."""
    finding = identify_example(UNLIMITED, backwards=False)
    undetermined = {"quicker", "slower", "threshold", "threshold_by_slope"}
    assert set(finding.prior_names) == {f"{channel}.{name}" for channel in ("v", "omega") for name in undetermined}
    for values in finding.fit.values:
        assert values["quicker"] == values["slower"] == NO_LIMIT
        assert values["threshold"] == values["threshold_by_slope"] == 0.0
    assert "v.quicker" not in finding.estimate.names
    assert finding.estimate.value("v.lag") == pytest.approx(0.1, rel=0.15)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Log of 30 s of a robot with two first-order lags."""
    folder = tmp_path_factory.mktemp("log")
    write_mapping(folder / "map.yaml")
    return write_csv(folder / "drive.csv", drive(seconds=30.0, dt=0.04))


@pytest.mark.parametrize("structure", ["p2_experimental", "p2_physical"])
def test_identified_drive_is_loaded_by_a_controller(log, structure, tmp_path):
    identification = identify(log, log.with_name("map.yaml"), structure)
    report = identification.report
    assert report.fitted.validation.fit_percent.min() > 90.0
    assert f"{structure}.v.gain" in report.as_json()["parameters"]
    assert structure.upper() in report.markdown()
    assert "Parameters of the linear model in addition to a drive" in report.markdown()
    assert any("none is modelled" in warning for warning in report.warnings), "no slope limit acts here"
    model = check_written(identification, tmp_path, 1e-3, structure)
    assert isinstance(model, DriveModel) and model.dt == 0.04
    # The robot has lags of 0.1 s and unit gain. The slow integral of the paper's PI control removes the gain error only
    # after seconds.
    tolerance = 0.02 if structure == "p2_experimental" else 0.04
    assert np.diag(model.dc_gain) == pytest.approx([1.0, 1.0], abs=tolerance)
    response = model.simulate(np.full((100, 2), 0.5)) / 0.5
    rise_time = LOG_DT * np.argmax(response > 1 - np.exp(-1), axis=0)
    assert rise_time == pytest.approx([0.1, 0.1], abs=LOG_DT)


def test_printed_pioneer_has_the_printed_numbers_and_damping():
    content = check(PhysicalFile, read_yaml(model_path("p2_pioneer")), "p2_pioneer")
    # Tables 1 and 2 in mm and kg mm^2, section 3.1.
    chassis = {"mass": 28.05, "wheel_radius": 95e-3, "track": 320e-3, "centre_ahead": 57.8e-3}
    assert content.chassis.model_dump() == chassis | {"yaw_inertia": 175e3 * 1e-6, "wheel_inertia": 9.24e-2 * 1e-6}
    drive, forward = content.wheel_drive, content.chassis.direct + content.chassis.cross
    assert (drive.integral_time, drive.actuator_lag, drive.friction) == (4.58, 1.1e-3, 35e-7)
    assert (content.sample_time, content.v.dead_samples, content.omega.dead_samples) == (0.1, 3, 3)
    # Poles of the loop without the slow integral: inertia speed' = torque, lag torque' = gain error - torque.
    poles = np.roots([drive.actuator_lag, 1.0, drive.proportional_gain / forward])
    assert -poles[0].real / abs(poles[0]) == pytest.approx(0.9, abs=1e-4)


def test_printed_pioneer_runs_only_at_its_sample_time():
    settings = {"model": "p2_pioneer", "sample_time": 0.1, "horizon": 15, "start_delay": 0.3}
    settings |= {"wheels.track": 0.32, "wheels.encoder_track": 0.32}
    run = simulate(load_config("p2_physical", settings), "model:p2_pioneer", "s")
    assert set(run.modes) == {"TRACKING"} and run.metrics.position_rmse_m < 0.02
    with pytest.raises(ModelError, match=r"samples of 0\.1 s"):
        make_plant("model:p2_pioneer")
