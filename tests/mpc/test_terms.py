"""User terms: effect on a drive, sources, and rejected definitions."""

import pickle

import casadi as ca
import numpy as np
import pytest
import yaml
from ideal_robot import IdealRobot, drive

from diffdrive_mpc import ConfigError, Controller, Term, load_config, load_model
from diffdrive_mpc.mpc.problem.terms import MAX_SOFT_ROWS
from diffdrive_mpc.mpc.step_result import Mode
from diffdrive_mpc.mpc.trajectories import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_segments
from refusals import one_line_error

LINE = time_segments([Segment(v=0.5, omega=0.0, duration=8.0)], TrajectoryLimits.of_robot(), name="line")
GOAL = LINE.sample([LINE.duration]).pose[0]
CONFIG = load_config("ssm")
DT, N, LIMITS = CONFIG.sample_time, CONFIG.horizon, CONFIG.limits
MODEL = load_model("ssm").with_extra_dead_time([CONFIG.extra_dead_time.v, CONFIG.extra_dead_time.omega]).discretise(DT)
FAR_AWAY = (10.0, 10.0)
# With re-entry the reference waits for a blocked robot; without re-entry the robot drives around the obstacle.
# These robots have no slip, unlike the mujoco plant for which the shipped estimator is tuned.
# The weights of the terms below are tuned for these weights of the controller.
WEIGHTS = {"weights.along": 250.0, "weights.v_increment": 40.0, "weights.omega_increment": 4.0}
WITH_REENTRY = WEIGHTS | {"estimator.side_slip": 0.0, "estimator.load_shift": 0.0}
WITHOUT_REENTRY = WITH_REENTRY | {"reentry.enabled": False}

FILE = """
import casadi as ca

pose, point = ca.SX.sym("pose", 3), ca.SX.sym("parameters", 2)
distance = ca.sqrt(ca.sumsqr(pose[:2] - point) + 1e-6)
# Ten units per metre: ten times the price of a shipped soft limit.
keep_off = ca.Function("keep_off", [pose, point], [10 * distance], ["pose", "parameters"], ["distance"])
push_off = ca.Function("push_off", [pose, point], [45 * ca.fmax(0.45 - distance, 0)], ["pose", "parameters"], ["near"])
"""
DEFINED: dict[str, ca.Function] = {}
exec(FILE, DEFINED)
KEEP_OFF = Term("keep_off", DEFINED["keep_off"], "soft", lower=[4.0], defaults=FAR_AWAY)
PUSH_OFF = Term("push_off", DEFINED["push_off"], defaults=FAR_AWAY)


def robot(**options):
    return IdealRobot(MODEL, np.zeros(3), **options)


def commands(results):
    return np.array([result.command for result in results])


def check_limits(results):
    sequence = commands(results)
    assert (np.abs(sequence) <= np.array([LIMITS.v, LIMITS.omega]) + 1e-9).all()
    assert (np.abs(np.diff(sequence, axis=0)) <= DT * np.array([LIMITS.v_slew, LIMITS.omega_slew]) + 1e-9).all()


# Distance from a moving point.


def resting_point(t):
    """Return a point next to the path."""
    return np.stack([2.0 + 0.0 * t, 0.25 + 0.0 * t], axis=-1)


def crossing_point(t):
    """Return a point that crosses the path when the robot arrives."""
    return np.stack([2.0 + 0.0 * t, 1.8 - 0.4 * t], axis=-1)


def drive_past(term, point, overrides, *, is_predicted=True):
    """Return results and minimum distance of a noisy drive past a point; `is_predicted` adds predicted positions."""
    controller = Controller(load_config("ssm", overrides), terms=[term] if term else [])

    def set_point(k, measurement):
        if term:
            ahead = DT * np.arange(N + 1) if is_predicted else 0.0 * np.arange(N + 1)
            controller.set_parameters(**{term.name: point(k * DT + ahead)})
        return measurement

    results, poses, times = drive(controller, robot(noise=1.0), LINE, LINE.duration + 1.5, change=set_point)
    return results, np.linalg.norm(poses[:, :2] - point(times), axis=1).min()


@pytest.mark.parametrize(
    ("term", "point", "overrides", "clearance"),
    [
        (KEEP_OFF, crossing_point, WITH_REENTRY, 0.39),
        (PUSH_OFF, crossing_point, WITH_REENTRY, 0.41),
        (KEEP_OFF, crossing_point, WITHOUT_REENTRY, 0.38),
        (KEEP_OFF, resting_point, WITHOUT_REENTRY, 0.36),
        (PUSH_OFF, resting_point, WITHOUT_REENTRY, 0.34),
    ],
)
def test_distance_term_keeps_the_robot_away_from_a_point(term, point, overrides, clearance):
    _, distance_without_term = drive_past(None, point, overrides)
    results, distance = drive_past(term, point, overrides)
    assert distance_without_term < 0.26
    assert distance > clearance
    assert {result.mode for result in results} == {Mode.TRACKING, Mode.FINISHED}
    check_limits(results)
    assert results[-1].estimate.pose == pytest.approx(GOAL, abs=0.02)


def test_predicted_positions_of_the_point_increase_the_distance():
    """Parameters with a row per future sample are compared with the current position at all samples."""
    _, without_prediction = drive_past(PUSH_OFF, crossing_point, WITHOUT_REENTRY, is_predicted=False)
    _, with_prediction = drive_past(PUSH_OFF, crossing_point, WITHOUT_REENTRY)
    assert with_prediction > without_prediction + 0.01


def test_violated_soft_limit_reduces_the_speed():
    """A speed limit is set during the drive: the robot slows down, and the reference waits."""
    twist, limit = ca.SX.sym("twist", 2), ca.SX.sym("parameters", 1)
    function = ca.Function("slow", [twist, limit], [20 * (twist[0] - limit)], ["twist", "parameters"], ["excess"])
    controller = Controller(CONFIG, terms=[Term("slow", function, "soft", upper=0.0, defaults=[1.0])])

    def set_point(k, measurement):
        if k == 100:
            controller.set_parameters(slow=[0.2])
        return measurement

    results, _, _ = drive(controller, robot(noise=1.0), LINE, 6.0, change=set_point)
    speed = np.array([result.estimate.twist[0] for result in results])
    assert speed[80:100] == pytest.approx(0.5, abs=0.03)
    assert speed[150:] == pytest.approx(0.2, abs=0.03)
    assert {result.mode for result in results} == {Mode.TRACKING}
    check_limits(results)


# A lower weight of the heading near the goal.


def test_residual_with_constant_weight_equals_the_shipped_cost():
    """A residual of the heading error times the square root of its weight replaces the shipped weight."""
    pose, reference = ca.SX.sym("pose", 3), ca.SX.sym("reference", 4)
    value = np.sqrt(28.0) * (pose[2] - reference[3])
    term = Term("heading", ca.Function("f", [reference, pose], [value], ["reference", "pose"], ["r"]))
    # A term has no terminal weight and does not take part in the compensation of side slip.
    settings = WEIGHTS | {"weights.terminal": 1.0, "compensation.side_slip": False}
    shipped, user_defined = (
        drive(Controller(load_config("ssm", settings | {"weights.heading": weight}), terms=terms), start, LINE, 6.0)[0]
        for weight, terms, start in ((28.0, [], displaced_robot()), (0.0, [term], displaced_robot()))
    )
    assert commands(user_defined) == pytest.approx(commands(shipped), abs=1e-9)
    assert np.abs(commands(shipped)[:, 1]).max() > 0.1


def displaced_robot():
    return IdealRobot(MODEL, [0.0, 0.03, 0.1])


# Terms together with shipped limits.


def test_shipped_soft_limits_are_satisfied_together_with_terms():
    corridor = {"limits.corridor": 0.05, "weights.soft": 500.0}
    max_offsets = []
    for overrides in (WITHOUT_REENTRY, WITHOUT_REENTRY | corridor):
        results, distance = drive_past(PUSH_OFF, resting_point, overrides)
        max_offsets.append(max(abs(result.estimate.pose[1]) for result in results))
        assert distance > 0.25
    assert max_offsets[0] > 0.1
    assert max_offsets[1] < 0.055


# Sources of terms.


def term_entries(**changes):
    entry = {"file": "mine.py", "function": "keep_off", "kind": "soft", "lower": [4.0], "parameters": list(FAR_AWAY)}
    return [{key: value for key, value in (entry | changes).items() if value is not ...}]


def load_with_terms(folder, text, entries):
    (folder / "mine.py").write_text(text)
    (folder / "config.yaml").write_text(yaml.safe_dump(CONFIG.model_dump() | {"terms": entries}))
    return load_config(folder / "config.yaml")


def test_configured_term_equals_the_term_in_python(tmp_path, monkeypatch):
    entries = term_entries() + term_entries(function="push_off", kind=..., lower=..., name="elbow")
    (tmp_path / "elsewhere").mkdir()
    configured = Controller(load_with_terms(tmp_path, FILE, entries))
    monkeypatch.chdir(tmp_path / "elsewhere")
    configured = pickle.loads(pickle.dumps(configured))
    in_python = Controller(CONFIG, terms=[KEEP_OFF, Term("elbow", DEFINED["push_off"], defaults=FAR_AWAY)])
    drives = []
    for controller in (configured, in_python):
        controller.set_parameters(keep_off=[1.0, 0.3], elbow=[1.5, -0.3])
        drives.append(commands(drive(controller, robot(noise=1.0), LINE, 4.0)[0]))
    assert (drives[0] == drives[1]).all()
    assert np.abs(drives[0][:, 1]).max() > 0.1


# Rejected definitions.

MINE = "term 'keep_off': "
HEAD = "import casadi as ca\npose, p = ca.SX.sym('pose', 3), ca.SX.sym('parameters', 2)\n"


def script(inputs, output="pose[0]", names=None):
    """Return a script that defines a function of these inputs."""
    labels = names or inputs.split(", ")
    return HEAD + f"x = ca.SX.sym('x', 2)\nkeep_off = ca.Function('f', [{inputs}], [{output}], {labels}, ['out'])\n"


@pytest.mark.parametrize(
    ("text", "changes", "message"),
    [
        (FILE, {"file": "none.py"}, "none.py: no such Python file; give the path of the term"),
        (script("pose, x", names=["pose", "twst"]), {}, MINE + "unknown input 'twst'; rename it to twist"),
        (script("pose", "pose[0] + x[0]").replace("['out'])", "['out'], {'allow_free': True})"), {}, "depends on x_0"),
        (FILE, {"lower": ...}, MINE + "kind soft without a limit; give upper or lower, or use kind residual"),
        (FILE, {"uper": [1.0]}, "unknown key 'terms.0.uper'; did you mean"),
    ],
)
def test_mistake_in_a_configured_term_raises_error_in_one_line(tmp_path, text, changes, message):
    # The message names the file.
    with one_line_error(ConfigError, message, str(tmp_path)):
        Controller(load_with_terms(tmp_path, text, term_entries(**changes)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"defaults": (1.0, float("nan"))}, "term 'mine': parameters [1.0, nan]; give finite numbers"),
        ({"function": lambda pose: pose}, "term 'mine': function is not a casadi.Function; build one with named"),
    ],
)
def test_mistake_in_a_python_term_raises_config_error(changes, message):
    arguments = {"name": "mine", "function": DEFINED["keep_off"], "kind": "soft", "lower": [4.0], "defaults": FAR_AWAY}
    with pytest.raises(ConfigError) as caught:
        Term(**(arguments | changes))
    assert str(caught.value).startswith(message)


def wide(rows):
    pose = ca.SX.sym("pose", 3)
    return ca.Function("wide", [pose], [ca.repmat(pose[0], rows, 1)], ["pose"], ["x"])


def test_too_many_rows_of_terms_raise_error():
    terms = [Term("a", wide(20), "soft", upper=20 * [5.0]), Term("b", wide(4), "soft", upper=4 * [5.0])]
    assert sum(term.rows for term in terms) == MAX_SOFT_ROWS
    Controller(load_config("ssm", {"horizon": 200}), terms=terms)
    with pytest.raises(ConfigError, match=r"25 rows in total \(a 20, b 4, c 1\), the maximum is 24; remove terms"):
        Controller(CONFIG, terms=[*terms, Term("c", wide(1), "soft", upper=5.0)])


def test_duplicate_term_names_raise_error():
    with pytest.raises(ConfigError, match="term 'keep_off': 2 terms have this name; give each term a unique name"):
        Controller(CONFIG, terms=[KEEP_OFF, KEEP_OFF])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("push_of", [1.0, 2.0], "term 'push_of': not found; there are: keep_off, push_off"),
        ("push_off", [1.0], "term 'push_off': give 2 parameters, or 31 rows of them (found shape (1,))"),
        (
            "push_off",
            [1.0, float("nan")],
            "term 'push_off': its parameters contain a value that is not finite; give finite numbers",
        ),
    ],
)
def test_wrong_term_parameters_raise_error_and_change_nothing(name, value, message):
    controller = Controller(CONFIG, terms=[KEEP_OFF, PUSH_OFF])
    with pytest.raises(ConfigError) as caught:
        controller.set_parameters(**{"keep_off": [5.0, 5.0], name: value})
    assert str(caught.value) == message
    assert (controller._tick.parameters == np.tile(FAR_AWAY, 2)).all()


def test_term_with_nan_stops_the_robot_with_a_message():
    pose = ca.SX.sym("pose", 3)
    function = ca.Function("root", [pose], [ca.sqrt(1.0 - pose[0])], ["pose"], ["x"])
    controller = Controller(CONFIG, terms=[Term("root", function)])
    results, poses, _ = drive(controller, robot(), LINE, 5.0)
    assert results[-1].mode is Mode.STOPPED
    assert "solve failed" in results[-1].message
    assert poses[-1, 0] < 1.3
