"""`diffdrive-mpc export`: exported files, and commands equal to those of the Python controller."""

import json
import re
import shutil
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from diffdrive_mpc import (
    Controller,
    Measurement,
    NonlinearModel,
    Stamped,
    Term,
    load_config,
    load_trajectory,
    make_plant,
)
from diffdrive_mpc.mpc import Mode
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.solver.report import SolverStatus
from diffdrive_mpc_extras.export.emulation import REPLY_BYTES, Reply, read_reply, request_bytes
from diffdrive_mpc_extras.export.generated_c import trajectory_texts
from diffdrive_mpc_extras.export.library import Precision, export_controller
from diffdrive_mpc_extras.turn_costs import load_turn_costs

HOST = Path(__file__).with_name("export_host.c")
# Some functions use their controller argument for sizes only; in an export, sizes are macros.
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wno-unused-parameter", "-Werror")


def export(
    folder: Path, trajectory: str, precision: str, overrides: dict, *flags: str, model: object = "ssm", terms=()
) -> Path:
    """Export a controller, compile it with the host program, with warnings as errors, and return the program."""
    folder.mkdir()
    config = load_config(model if isinstance(model, str) else "ssm", {"horizon": 15, **overrides})
    custom_model = None if isinstance(model, str) else model
    reference = load_trajectory(trajectory)
    export_controller(config, reference, folder, Precision(precision), model=custom_model, terms=terms)
    sources = [HOST, folder / "stm32f4" / "frames.c", *sorted((folder / "ddmpc").glob("*.c"))]
    includes = [f"-I{folder / name}" for name in ("ddmpc", "stm32f4")]
    compile_c(*STRICT, *flags, *includes, *map(str, sources), "-lm", "-o", str(folder / "host"))
    return folder / "host"


def compile_c(*arguments: str) -> None:
    assert shutil.which("gcc"), "gcc was not found: install a C compiler (Debian: apt-get install gcc libc6-dev)"
    result = subprocess.run(["gcc", *arguments], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


class ExportedController:
    """Exported controller in the host program, with `start` and `step` as in `mpc.Controller`."""

    def __init__(self, program: Path) -> None:
        self._process = subprocess.Popen(
            [str(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        self._needs_restart = True
        self.invalid_from = np.inf
        """Time of the reference from which its poses are NaN [s]."""

    def start(self, reference, t0: float) -> None:
        self._needs_restart = True

    def step(self, t: float, measurement: Measurement, hold: Hold | None = None) -> Reply:
        frame = struct.pack("<d", self.invalid_from) + request_bytes(t, measurement, hold, restart=self._needs_restart)
        self._needs_restart = False
        self._process.stdin.write(frame)
        self._process.stdin.flush()
        data = self._process.stdout.read(REPLY_BYTES)
        assert len(data) == REPLY_BYTES, self._process.communicate()[1].decode()
        return read_reply(data)

    def close(self) -> None:
        """Stop the process; check that it reports no error."""
        _, errors = self._process.communicate(timeout=10)
        assert self._process.returncode == 0, errors.decode()


class InvalidReference:
    """Trajectory whose poses are NaN from `invalid_from` [s]."""

    def __init__(self, name: str) -> None:
        self._trajectory = load_trajectory(name)
        self.name, self.duration, self.invalid_from = name, self._trajectory.duration, np.inf

    def sample(self, times):
        sample = self._trajectory.sample(times)
        sample.pose[np.asarray(times, dtype=float) >= self.invalid_from] = np.nan
        return sample


def drive_both(
    program: Path,
    trajectory: str,
    overrides: dict,
    ticks: int,
    *,
    offset=(0.0, 0.0, 0.0),
    change=None,
    model: object = "ssm",
    terms=(),
):
    """Drive a noisy robot with the Python controller, give the exported controller the same data; return both steps.

    `change(k, measurement, exported, reference)` may modify a tick; it returns time shift, measurement and hold.
    """
    is_name = isinstance(model, str)
    config = load_config(model if is_name else "ssm", {"horizon": 15, "reentry.enabled": False, **overrides})
    controller, exported = Controller(config, None if is_name else model, terms), ExportedController(program)
    reference = InvalidReference(trajectory)
    start = reference.sample([0.0]).pose[0] + offset
    robot = make_plant("model:ssm", seed=0)
    robot.reset(start)
    controller.start(reference, 0.0)
    exported.start(reference, 0.0)
    steps = []
    for k in range(ticks):
        shift, measurement, hold = 0.0, robot.measure(), None
        if change is not None:
            shift, measurement, hold = change(k, measurement, exported, reference)
        t = robot.time + shift
        steps.append((controller.step(t, measurement, hold), exported.step(t, measurement, hold)))
        robot.advance(steps[-1][0].command)
    exported.close()
    return steps


def differences(steps) -> np.ndarray:
    """Return (n, 2) differences of the commands."""
    return np.array([python.command - exported.command for python, exported in steps])


def check_equal(steps, tolerance):
    """Check that the modes are equal and that the commands agree within `tolerance` [m/s, rad/s]."""
    assert [python.mode for python, _ in steps] == [exported.mode for _, exported in steps]
    assert np.abs(differences(steps)).max() <= tolerance


# Limits that are active in the corners of the square.
TIGHT = {"limits.omega": 1.0, "limits.v": 0.52, "limits.v_slew": 1.0, "limits.omega_slew": 2.5}
# Tolerance of the commands in double precision [m/s, rad/s].
DOUBLE = 1e-6


@pytest.fixture(scope="module")
def double_program(tmp_path_factory):
    return export(tmp_path_factory.mktemp("export") / "double", "square", "double", TIGHT, "-O0")


@pytest.fixture(scope="module")
def sanitized_program(tmp_path_factory):
    """Program with soft limits that stops at the first access out of bounds or undefined operation."""
    folder = tmp_path_factory.mktemp("export") / "sanitized"
    overrides = {"limits.wheel_speed": 0.58, "failure.resume": False, "failure.dead_reckoning": 0.0}
    return export(folder, "s", "double", overrides, "-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def test_commands_with_hard_limits_equal_those_of_python(double_program):
    steps = drive_both(double_program, "square", TIGHT, 350, offset=(0.02, -0.03, 0.1))
    check_equal(steps, DOUBLE)
    has_active_limits = np.array([exported.iterations > 0 for _, exported in steps])
    assert has_active_limits.mean() > 0.2
    assert not has_active_limits.all()
    assert {python.mode for python, _ in steps} == {Mode.TRACKING}


def test_commands_with_soft_limits_equal_those_of_python(sanitized_program):
    steps = drive_both(sanitized_program, "s", {"limits.wheel_speed": 0.58, "failure.resume": False}, 150)
    assert np.abs(differences(steps)).max() <= DOUBLE
    assert sum(exported.soft_limits > 0 for _, exported in steps) > 50


def track_both(
    folder, trajectory, overrides, ticks, *flags, precision="double", tolerance=DOUBLE, offset=(0, 0, 0), **options
):
    """Export, drive both controllers, check that both track with equal commands, and return their steps."""
    program = export(folder / precision, trajectory, precision, overrides, "-O0", *flags, **options)
    steps = drive_both(program, trajectory, overrides, ticks, offset=offset, **options)
    check_equal(steps, tolerance)
    assert {python.mode for python, _ in steps} == {Mode.TRACKING}
    return steps


def test_commands_in_single_precision_differ_by_rounding_only(tmp_path):
    """Both controllers solve the same QP exactly."""
    steps = track_both(tmp_path, "square", TIGHT, 350, precision="float", tolerance=2e-4, offset=(0.02, -0.03, 0.1))
    assert sum(exported.iterations > 0 for _, exported in steps) > 50


def test_commands_of_a_stopped_solve_equal_those_of_python(tmp_path):
    limits = {"limits.wheel_speed": 0.58, "solver.active_set_iterations": 1}
    steps = track_both(tmp_path, "s", limits, 200)
    assert sum(python.solver.status is SolverStatus.STOPPED for python, _ in steps) > 20


def test_commands_with_model_mbm_and_dead_time_equal_those_of_python(tmp_path):
    """Drive with eight states, another horizon, and dead times of two and three samples."""
    overrides = {"horizon": 12, "extra_dead_time.v": 0.05, "extra_dead_time.omega": 0.03}
    track_both(tmp_path, "s", overrides, 100, offset=(0.0, 0.04, 0.1), model="mbm")


def test_curved_slip_and_a_min_turn_radius_are_exported(tmp_path):
    overrides = {"estimator.veer_uncertainty": 0.02, "estimator.yaw_coupling": 0.05, "limits.min_turn_radius": 0.95}
    overrides["limits.min_commanded_radius"] = 1.2
    steps = track_both(tmp_path, "s", overrides, 120, "-fsanitize=address,undefined", offset=(0.0, 0.04, 0.1))
    assert sum(exported.soft_limits > 0 for _, exported in steps) > 20
    commands = np.abs([exported.command for _, exported in steps])
    assert (1.2 * commands[:, 1] <= commands[:, 0] + 1e-12).all()
    assert np.isclose(1.2 * commands[:, 1], commands[:, 0]).sum() > 20


def test_energy_term_and_its_min_radius_are_exported(tmp_path):
    overrides = {"energy.turn_costs": "fsu_bot-carpet", "energy.weight": 0.01, "energy.use_min_radius": True}
    overrides["horizon"] = 12
    steps = track_both(tmp_path, "circle", overrides, 120, offset=(0.0, 0.03, 0.05))
    radius = load_turn_costs("fsu_bot-carpet").least_radius()
    commands = np.abs([exported.command for _, exported in steps])
    assert (radius * commands[:, 1] <= commands[:, 0] + 1e-12).all()
    assert np.isclose(radius * commands[:, 1], commands[:, 0]).any()


def test_exported_controller_finishes_at_the_end_of_the_reference(double_program):
    """The square ends at its start, so the robot starts there shortly before the end of the reference."""
    shift = 856 * 0.0202

    def change(k, measurement, exported, reference):
        return shift, delay(measurement, shift), None

    steps = drive_both(double_program, "square", TIGHT, 150, change=change)
    check_equal(steps, DOUBLE)
    assert steps[0][1].mode == Mode.TRACKING
    assert steps[-1][1].mode == Mode.FINISHED


def delay(measurement: Measurement, shift: float) -> Measurement:
    """Return the measurement with stamps later by `shift` [s]."""
    parts = {
        name: replace(stamped, time=stamped.time + shift)
        for name in ("pose", "wheel_twist", "yaw_rate")
        if (stamped := getattr(measurement, name)) is not None
    }
    return replace(measurement, **parts)


def events(k, measurement, exported, reference):
    """Insert different errors into a drive."""
    shift, hold = 0.0, None
    if k < 3 or 30 <= k < 60:
        measurement = replace(measurement, pose=None)
    elif k == 80:
        measurement = Measurement(Stamped((np.nan, 0.0, 0.0), measurement.pose.time), measurement.wheel_twist)
    elif 90 <= k < 120:  # the robot is moved by hand
        pose = np.asarray(measurement.pose.value) + [0.4, 0.1, 0.0]
        measurement = replace(measurement, pose=replace(measurement.pose, value=pose))
    elif k == 125:
        shift = -1.0  # the clock runs backwards
    elif k == 130:
        shift = 5.0  # the clock jumps for one tick
    elif k == 140:
        measurement = replace(measurement, sent=(0.1, -0.2))
    elif k == 141:
        measurement = replace(measurement, sent=(np.nan, 0.0))
    elif 150 <= k < 156:
        hold = Hold("requested by the operator")
    elif k == 170:
        measurement = replace(measurement, yaw_rate=Stamped(50.0, measurement.yaw_rate.time))
    exported.invalid_from = reference.invalid_from = np.inf
    if 180 <= k < 190:  # no solve succeeds
        exported.invalid_from = reference.invalid_from = (k + 0.5) * 0.0202
    return shift, measurement, hold


def test_exported_controller_passes_all_stages_of_the_failure_ladder(double_program):
    steps = drive_both(double_program, "square", TIGHT, 230, change=events)
    check_equal(steps, DOUBLE)
    modes = [exported.mode for _, exported in steps]
    assert set(modes) == {Mode.TRACKING, Mode.REUSED_PLAN, Mode.BRAKING, Mode.STOPPED}
    assert modes[180:185] == [Mode.REUSED_PLAN] * 5
    assert modes[185] == Mode.BRAKING
    assert modes[-1] == Mode.TRACKING


def test_failure_latches_if_the_robot_must_not_resume(sanitized_program):
    overrides = {"limits.wheel_speed": 0.58, "failure.resume": False, "failure.dead_reckoning": 0.0}
    steps = drive_both(sanitized_program, "s", overrides, 100, change=events)
    check_equal(steps, DOUBLE)
    assert steps[-1][1].mode == Mode.STOPPED


def test_early_ticks_and_pauses_give_the_same_steps_as_in_python(double_program):
    def change(k, measurement, exported, reference):
        shift = -0.6 * 0.0202 if k == 20 else 0.0  # earlier than the sample time
        shift += 3.0 if k >= 40 else 0.0  # a pause
        return shift, delay(measurement, 3.0) if k >= 40 else measurement, None

    steps = drive_both(double_program, "square", TIGHT, 60, change=change)
    check_equal(steps, DOUBLE)
    assert {exported.mode for _, exported in steps[40:]} >= {Mode.STOPPED}


def saturating_lag() -> NonlinearModel:
    """Build a lag of 0.1 s in both channels with saturated acceleration; its input is the older command."""
    x, window, dt = ca.SX.sym("x", 2), ca.SX.sym("window", 4), 0.0202
    max_acceleration = ca.DM([1.5, 6.0])
    next_x = x + dt * max_acceleration * ca.tanh((window[:2] - x) / (0.1 * max_acceleration))
    step = ca.Function("step", [x, window], [next_x], ["x", "window"], ["after"])
    return NonlinearModel("lag", step, ca.Function("output", [x], [x], ["x"], ["y"]), dt)


def user_terms(point) -> tuple[Term, ...]:
    """Build a residual that penalises turning, and a soft limit on the distance from a point (2) [m]."""
    pose, twist, parameters = ca.SX.sym("pose", 3), ca.SX.sym("twist", 2), ca.SX.sym("parameters", 3)
    turning = ca.Function("calm", [twist], [2 * twist[1]], ["twist"], ["value"])
    distance = ca.sqrt((pose[0] - parameters[0]) ** 2 + (pose[1] - parameters[1]) ** 2 + 1e-4) - parameters[2]
    clearance = ca.Function("away", [pose, parameters], [distance], ["pose", "parameters"], ["value"])
    return Term("calm", turning), Term("away", clearance, "soft", lower=[0.0], defaults=[*point, 0.2])


@pytest.mark.parametrize(("precision", "tolerance"), [("double", DOUBLE), ("float", 2e-4)])
def test_commands_with_user_functions_equal_those_of_python(tmp_path, precision, tolerance):
    """Drive with a nonlinear model and two terms."""
    terms = user_terms(load_trajectory("circle").sample([2.5]).pose[0, :2])
    options = {"precision": precision, "tolerance": tolerance, "offset": (0.0, 0.03, 0.0)}
    steps = track_both(tmp_path, "circle", {}, 200, model=saturating_lag(), terms=terms, **options)
    assert sum(exported.soft_limits > 0 for _, exported in steps) > 10


@pytest.mark.parametrize(
    ("model", "precision", "tolerance"),
    [("lstm", "double", DOUBLE), ("lstm", "float", 2e-3), ("p2_experimental", "double", DOUBLE)],
)
def test_networks_and_drive_models_are_exported(tmp_path, model, precision, tolerance):
    """Networks have weights as tables; the experimental drive has slope limits and a threshold."""
    track_both(tmp_path, "circle", {}, 60, precision=precision, tolerance=tolerance, model=model)


COMMAND = Path(sys.executable).with_name("diffdrive-mpc")


def run(folder, *arguments):
    command = [str(COMMAND), "export", "--set", "horizon=8", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_export_command_writes_a_complete_folder(tmp_path):
    result = run(tmp_path, "--model", "mbm", "--precision", "float", "--out", "out")
    assert result.returncode == 0, result.stderr
    report = json.loads((tmp_path / "out" / "export.json").read_text())
    assert (report["model"], report["states"], report["horizon"], report["precision"]) == ("mbm", 8, 8, "float")
    assert report["config"]["solver"]["active_set_iterations"] == report["iteration_limit"]
    sizes = {size["target"]: size for size in report["sizes"]}
    readme = (tmp_path / "out" / "README.md").read_text()
    assert "{" not in readme.replace("input = {0}", "").replace("{\n", "")
    assert f"{sizes['host example']['ram_bytes']:,}" in readme
    example = tmp_path / "example"
    out = tmp_path / "out"
    sources = [str(path) for path in sorted((out / "ddmpc").glob("*.c"))]
    compile_c("-std=c99", f"-I{out / 'ddmpc'}", *sources, str(out / "examples" / "main.c"), "-lm", "-o", str(example))
    # The example drives a robot that follows its model exactly: the error is a few centimetres at the start.
    output = subprocess.run([str(example)], capture_output=True, text=True, check=True).stdout
    assert "\nfinished, maximum error 0.0" in output
    listing = subprocess.run(["nm", "-u", str(example)], capture_output=True, text=True, check=True).stdout
    symbols = {line.split()[-1].split("@")[0] for line in listing.splitlines()}
    assert not {"malloc", "calloc", "realloc", "free"} & symbols


def test_same_configuration_gives_identical_files(tmp_path):
    config, reference = load_config("ssm", {"horizon": 8}), load_trajectory("circle")
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        export_controller(config, reference, tmp_path / name, Precision.FLOAT)
    first, second = (
        {path.relative_to(tmp_path / name): path.read_bytes() for path in (tmp_path / name).rglob("*.*")}
        for name in ("first", "second")
    )
    assert first == second


def test_reference_that_is_not_finite_raises_value_error(tmp_path):
    reference = InvalidReference("circle")
    reference.invalid_from = 5.0
    with pytest.raises(ValueError, match="reference 'circle'.*not finite"):
        trajectory_texts(reference, 0.0202)


def read_array(source: str, name: str) -> list[float]:
    body = re.search(rf" {name}\[\] = {{([^}}]*)}}", source)[1]
    return [float(number) for number in body.split(",")]


def test_reference_without_closed_form_is_interpolated_by_cubic_pieces():
    """There is one piece per sample; the ends of the pieces are poses of the reference."""
    reference = InvalidReference("s")
    source = trajectory_texts(reference, 0.5)["trajectory.c"]
    breaks = read_array(source, "breaks")
    table = np.reshape(read_array(source, "table"), (16, -1))
    assert table.shape[1] == int(np.ceil(reference.duration / 0.5)) == len(breaks) - 1
    # The constant coefficients are the poses at the starts of the pieces.
    assert np.allclose(table[12:15].T, reference.sample(breaks[:-1]).pose)
    assert ".cubic = 1" in source


HOSTILE_NAMES = (
    "x *\\\n/ int hidden = 1; /*",
    "x */ int hidden = 1; /*",
    "x ??/\n */ int hidden;",
    "a\nlimits: 99\r\x1b[2J\u202e\x85\u2028b",
)


def test_trajectory_name_is_exported_as_a_comment_only():
    for name in HOSTILE_NAMES:
        reference = load_trajectory("circle")
        object.__setattr__(reference, "name", name)
        header = trajectory_texts(reference, 0.02)["trajectory.h"]
        (comment,) = [line for line in header.splitlines() if line.startswith("/*")]
        assert comment.endswith(" */")
        assert not set("*/\\?") & set(comment[2:-2])
        assert header.count("/*") == header.count("*/") == 1
