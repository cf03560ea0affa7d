"""The exported controller: what is written, and that it commands as in Python."""

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
# Some parts ask a controller for sizes that are macros in an export.
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wno-unused-parameter", "-Werror")


def export(
    folder: Path, trajectory: str, precision: str, overrides: dict, *flags: str, model: object = "ssm", terms=()
) -> Path:
    """Export and compile with the host program, with warnings as errors."""
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
    """Drives the host program; `start` and `step` are those of `mpc.Controller`."""

    def __init__(self, program: Path) -> None:
        self._process = subprocess.Popen(
            [str(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        self._anew = True
        self.spoiled_from = np.inf
        """Time of the reference from which on its poses are NaN [s]."""

    def start(self, reference, t0: float) -> None:
        self._anew = True

    def step(self, t: float, measurement: Measurement, hold: Hold | None = None) -> Reply:
        frame = struct.pack("<d", self.spoiled_from) + request_bytes(t, measurement, hold, anew=self._anew)
        self._anew = False
        self._process.stdin.write(frame)
        self._process.stdin.flush()
        data = self._process.stdout.read(REPLY_BYTES)
        assert len(data) == REPLY_BYTES, self._process.communicate()[1].decode()
        return read_reply(data)

    def close(self) -> None:
        """End the process; it must have nothing to complain of."""
        _, complaints = self._process.communicate(timeout=10)
        assert self._process.returncode == 0, complaints.decode()


class SpoiledReference:
    """A trajectory whose poses are NaN from `spoiled_from` [s] on."""

    def __init__(self, name: str) -> None:
        self._inner = load_trajectory(name)
        self.name, self.duration, self.spoiled_from = name, self._inner.duration, np.inf

    def sample(self, times):
        sample = self._inner.sample(times)
        sample.pose[np.asarray(times, dtype=float) >= self.spoiled_from] = np.nan
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
    """Drive a noisy robot with the Python controller; the exported one gets the same data; return the steps of both.

    `change(k, measurement, exported, reference)` may spoil things and returns time shift, measurement and hold.
    """
    named = isinstance(model, str)
    config = load_config(model if named else "ssm", {"horizon": 15, "reentry.enabled": False, **overrides})
    controller, exported = Controller(config, None if named else model, terms), ExportedController(program)
    reference = SpoiledReference(trajectory)
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
    return np.array([ours.command - theirs.command for ours, theirs in steps])


def check_same(steps, within):
    """Check that modes are the same and commands differ by no more than `within`."""
    assert [ours.mode for ours, _ in steps] == [theirs.mode for _, theirs in steps]
    assert np.abs(differences(steps)).max() <= within


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
    check_same(steps, DOUBLE)
    solved = np.array([theirs.iterations > 0 for _, theirs in steps])
    assert solved.mean() > 0.2  # constraints were active
    assert not solved.all()  # and were not
    assert {ours.mode for ours, _ in steps} == {Mode.TRACKING}


def test_soft_limits_in_double_precision(with_sanitizers):
    steps = drive_both(with_sanitizers, "s", {"limits.wheel_speed": 0.58, "failure.resume": False}, 150)
    assert np.abs(differences(steps)).max() <= DOUBLE
    assert sum(theirs.soft_limits > 0 for _, theirs in steps) > 50


def track_both(
    folder, trajectory, overrides, ticks, *flags, precision="double", within=DOUBLE, offset=(0, 0, 0), **options
):
    """Compare steps of an export and of Python's controller, which track, and differ by no more than `within`."""
    program = export(folder / precision, trajectory, precision, overrides, "-O0", *flags, **options)
    steps = drive_both(program, trajectory, overrides, ticks, offset=offset, **options)
    check_same(steps, within)
    assert {ours.mode for ours, _ in steps} == {Mode.TRACKING}
    return steps


def test_single_precision(tmp_path):
    """Rounding only: both stop at the exact solution of the same program."""
    steps = track_both(tmp_path, "square", TIGHT, 350, precision="float", within=2e-4, offset=(0.02, -0.03, 0.1))
    assert sum(theirs.iterations > 0 for _, theirs in steps) > 50


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
    overrides = {"energy.turn_costs": "fsu_bot-carpet", "energy.weight": 0.01, "energy.use_min_radius": True}
    overrides["horizon"] = 12
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
    check_same(steps, DOUBLE)
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
    """Insert one error after the other into the drive."""
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
    check_same(steps, DOUBLE)
    modes = [theirs.mode for _, theirs in steps]
    assert set(modes) == {Mode.TRACKING, Mode.REUSED_PLAN, Mode.BRAKING, Mode.STOPPED}
    assert modes[180:185] == [Mode.REUSED_PLAN] * 5
    assert modes[185] == Mode.BRAKING
    assert modes[-1] == Mode.TRACKING


def test_a_failure_latches_where_the_robot_must_not_resume(with_sanitizers):
    overrides = {"limits.wheel_speed": 0.58, "failure.resume": False, "failure.dead_reckoning": 0.0}
    steps = drive_both(with_sanitizers, "s", overrides, 100, change=events)
    check_same(steps, DOUBLE)
    assert steps[-1][1].mode == Mode.STOPPED


def test_ticks_too_soon_and_pauses(in_double):
    def change(k, measurement, exported, reference):
        shift = -0.6 * 0.0202 if k == 20 else 0.0  # too soon after the tick before
        shift += 3.0 if k >= 40 else 0.0  # a pause
        return shift, later(measurement, 3.0) if k >= 40 else measurement, None

    steps = drive_both(in_double, "square", TIGHT, 60, change=change)
    check_same(steps, DOUBLE)
    assert {theirs.mode for _, theirs in steps[40:]} >= {Mode.STOPPED}


def saturating_lag() -> NonlinearModel:
    """Build a lag of 0.1 s in both channels, whose acceleration saturates; the older command of the window acts."""
    x, window, dt = ca.SX.sym("x", 2), ca.SX.sym("window", 4), 0.0202
    most = ca.DM([1.5, 6.0])
    after = x + dt * most * ca.tanh((window[:2] - x) / (0.1 * most))
    step = ca.Function("step", [x, window], [after], ["x", "window"], ["after"])
    return NonlinearModel("lag", step, ca.Function("output", [x], [x], ["x"], ["y"]), dt)


def terms_of_the_user(point) -> tuple[Term, ...]:
    """Build a residual that penalises turning, and a soft limit on the distance from a point."""
    pose, twist, parameters = ca.SX.sym("pose", 3), ca.SX.sym("twist", 2), ca.SX.sym("parameters", 3)
    calm = ca.Function("calm", [twist], [2 * twist[1]], ["twist"], ["value"])
    distance = ca.sqrt((pose[0] - parameters[0]) ** 2 + (pose[1] - parameters[1]) ** 2 + 1e-4) - parameters[2]
    away = ca.Function("away", [pose, parameters], [distance], ["pose", "parameters"], ["value"])
    return Term("calm", calm), Term("away", away, "soft", lower=[0.0], defaults=[*point, 0.2])


@pytest.mark.parametrize(("precision", "within"), [("double", DOUBLE), ("float", 2e-4)])
def test_functions_of_the_user(tmp_path, precision, within):
    """A nonlinear model and two terms: the same C as Python's."""
    terms = terms_of_the_user(load_trajectory("circle").sample([2.5]).pose[0, :2])
    options = {"precision": precision, "within": within, "offset": (0.0, 0.03, 0.0)}
    steps = track_both(tmp_path, "circle", {}, 200, model=saturating_lag(), terms=terms, **options)
    assert sum(theirs.soft_limits > 0 for _, theirs in steps) > 10


@pytest.mark.parametrize(
    ("model", "precision", "within"),
    [("lstm", "double", DOUBLE), ("lstm", "float", 2e-3), ("p2_experimental", "double", DOUBLE)],
)
def test_networks_and_drives_come_along(tmp_path, model, precision, within):
    """A network's weights as tables; slope limits and, of the experimental drive, its threshold."""
    track_both(tmp_path, "circle", {}, 60, precision=precision, within=within, model=model)


COMMAND = Path(sys.executable).with_name("diffdrive-mpc")


def run(folder, *words):
    command = [str(COMMAND), "export", "--set", "horizon=8", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_the_folder_is_complete(tmp_path):
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
    # It drives a robot that obeys its model exactly: a few centimetres while it starts, and to the end.
    output = subprocess.run([str(example)], capture_output=True, text=True, check=True).stdout
    assert "\nfinished, largest error 0.0" in output
    system = subprocess.run(["nm", "-u", str(example)], capture_output=True, text=True, check=True).stdout
    needed = {line.split()[-1].split("@")[0] for line in system.splitlines()}
    assert not {"malloc", "calloc", "realloc", "free"} & needed


def test_the_same_configuration_gives_the_same_files(tmp_path):
    config, reference = load_config("ssm", {"horizon": 8}), load_trajectory("circle")
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        export_controller(config, reference, tmp_path / name, Precision.FLOAT)
    first, second = (
        {path.relative_to(tmp_path / name): path.read_bytes() for path in (tmp_path / name).rglob("*.*")}
        for name in ("first", "second")
    )
    assert first == second


def test_an_impossible_reference_is_refused(tmp_path):
    reference = SpoiledReference("circle")
    reference.spoiled_from = 5.0
    with pytest.raises(ValueError, match="reference 'circle'.*not finite"):
        trajectory_texts(reference, 0.0202)


def numbers_of(source: str, name: str) -> list[float]:
    body = re.search(rf" {name}\[\] = {{([^}}]*)}}", source)[1]
    return [float(number) for number in body.split(",")]


def test_any_other_reference_is_fitted():
    """Cubic pieces, one a sample, that meet the reference at their ends."""
    reference = SpoiledReference("s")
    source = trajectory_texts(reference, 0.5)["trajectory.c"]
    breaks = numbers_of(source, "breaks")
    table = np.reshape(numbers_of(source, "table"), (16, -1))
    assert table.shape[1] == int(np.ceil(reference.duration / 0.5)) == len(breaks) - 1
    # The constant coefficients: the poses where the pieces begin.
    assert np.allclose(table[12:15].T, reference.sample(breaks[:-1]).pose)
    assert ".cubic = 1" in source


HOSTILE_NAMES = (
    "x *\\\n/ int hidden = 1; /*",
    "x */ int hidden = 1; /*",
    "x ??/\n */ int hidden;",
    "a\nlimits: 99\r\x1b[2J\u202e\x85\u2028b",
)


def test_name_of_a_trajectory_is_never_code_in_the_export():
    for name in HOSTILE_NAMES:
        reference = load_trajectory("circle")
        object.__setattr__(reference, "name", name)
        header = trajectory_texts(reference, 0.02)["trajectory.h"]
        (comment,) = [line for line in header.splitlines() if line.startswith("/*")]
        assert comment.endswith(" */")
        assert not set("*/\\?") & set(comment[2:-2])
        assert header.count("/*") == header.count("*/") == 1
