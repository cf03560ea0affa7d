"""One drive with the monitor behind its controller, and what came of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from studies.monitor.faults import AT_START, FAULTS, Fault
from studies.monitor.watched import MonitoredController

from diffdrive_mpc.bench.case import NO_MODEL, Case
from diffdrive_mpc.bench.controllers import build
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim import Run, simulate
from diffdrive_mpc.sim.plants.names import DRAWN
from diffdrive_mpc_monitor.rules import Rules

# Drives in which nothing is wrong: drawn from controllers, paths, floors, what happens there, and sensors.


CONTROLLERS = (
    *(("mpc", model) for model in ("ssm", "ssm", "sm", "mbm", "kinematic")),
    *((peer, NO_MODEL) for peer in ("pursuit+slip", "kanayama+slip", "lqr+slip")),
)
"""Each with its model; the SSM drives twice as often."""
PREDICTIVE = tuple(pair for pair in CONTROLLERS if pair[0] == "mpc")
THROWN_OFF = frozenset({"push", "start_offset"})
"""Here only the MPC drives: a plain law that is thrown off a fast path is half a metre away before it is back, which is
no sound drive (two alarms in 276 drives from seed 10000 on were of these, and right)."""
PATHS = ("circle", "square", "s", "cane", "figure8", "fast_circle", "slalom", "reverse_slalom", "k_turn", "spiral")
BENCH_PATHS = ("circle", "square", "s", "cane")
"""Those that robots of the market are drawn for."""
SPLINES = 40
"""Beside these, so many random paths."""
_FLOORS = ("default", "default", "carpet", "deep_carpet", "grippy", "slippery")
_HAPPENINGS = ("push", "patches", "payload", "slope", "start_offset")
PLACES = (*((floor, "none") for floor in _FLOORS), *(("default", happening) for happening in _HAPPENINGS))
"""Floors, and what happens there."""
SENSORS = (
    *("default", "default", "slam", "noise_2cm", "poses_100ms"),
    *("poses_20hz", "poses_10hz", "poses_5hz", "poses_2hz"),
)


def nominal_case(seed: int) -> Case:
    """The drive of a seed."""
    draw = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1971,)))

    def one_of(values: tuple[Any, ...]) -> Any:  # noqa: ANN401 - of what is given
        return values[int(draw.integers(len(values)))]

    controller, model = one_of(CONTROLLERS)
    surface, scenario = one_of(PLACES)
    if scenario in THROWN_OFF:
        controller, model = one_of(PREDICTIVE)
    trajectory = one_of((*PATHS, *(f"spline-{k}" for k in range(SPLINES // 4))))
    if trajectory.startswith("spline-"):
        trajectory = f"spline-{int(draw.integers(SPLINES))}"
    return Case(
        controller=controller,
        model=model,
        trajectory=trajectory,
        surface=surface,
        scenario=scenario,
        sensors=one_of(SENSORS),
        seed=seed,
    )


FAULTY_PATHS = ("s", "square", "cane", "figure8", "slalom", "spline-0", "spline-1", "spline-2")
"""Paths that faulty controllers drive: they bend, or what goes on as before would be right."""
AFTER, _AFTER_FAULT = 3.0, 8.0
"""So long a drive goes on after the end of its reference [s]."""
_FIRST, _LAST = 2.5, 5.0
"""A fault begins between these [s]."""
HARM = 1.0
"""A robot does harm that comes so far from the stretch of path around its reference [m], or cannot be stopped."""
_AT_REST = 0.05
"""A robot slower than this stands [m/s, rad/s]."""
_NEAR = (6.0, 1.0)
"""Harm is measured to where the reference was up to so long ago, and will be up to so much later [s]."""


@dataclass(frozen=True)
class MonitorTrial:
    """What came of one drive.

    Attributes
    ----------
    case
        What was driven.
    fault
        Name of the fault; empty without one.
    driven
        How long [s].
    rule, words
        Of the verdict; empty without one.
    after
        From the fault, or else the start, to the verdict [s]; NaN without one.
    farthest
        From the stretch of path around the reference, of the true pose, until the robot stands for good [m].
    fastest
        True speed meanwhile [m/s].
    at_rest
        Whether the robot stands at the end.
    left
        Whether it leaves the stretch around its reference (`LEFT`, `ON_TIME`) without fault and monitor, too: an alarm
        is then no false one. Without an alarm: whether it did.
    """

    case: Case
    fault: str
    driven: float
    rule: str
    words: str
    after: float
    farthest: float
    fastest: float
    at_rest: bool
    left: bool


def nominal_trial(seed: int, rules: Rules) -> MonitorTrial:
    """A drive in which nothing is wrong."""
    return _drive(nominal_case(seed), "", 0.0, rules)


def market_case(seed: int) -> Case:
    """A drive of a drawn robot of the market: the same robot is not drawn twice, path and model are drawn with it."""
    draw = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1973,)))
    path, model = (names[int(draw.integers(len(names)))] for names in (BENCH_PATHS, [m for _, m in PREDICTIVE]))
    return Case(model=model, trajectory=path, plant=f"{DRAWN}:{seed}", seed=seed)


def market_trial(seed: int, rules: Rules) -> MonitorTrial:
    """A drive of a drawn robot in which nothing is wrong but the robot."""
    return _drive(market_case(seed), "", 0.0, rules)


def faulty_trial(fault: str, seed: int, rules: Rules) -> MonitorTrial:
    """A drive of the MPC that breaks on its way; path and instant are drawn."""
    draw = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1972,)))
    path = FAULTY_PATHS[int(draw.integers(len(FAULTY_PATHS)))]
    begins = 0.0 if fault in AT_START else float(draw.uniform(_FIRST, _LAST))
    controller = FAULTS[fault].controller
    model = Case().model if controller == "mpc" else NO_MODEL
    return _drive(Case(controller=controller, model=model, trajectory=path, seed=seed), fault, begins, rules)


def _drive(case: Case, fault: str, begins: float, rules: Rules) -> MonitorTrial:
    controller, plant, reference = build(case)
    broken = FAULTS[fault].make(begins) if fault else Fault()
    watched = MonitoredController(controller, rules, broken)
    run = simulate(watched, plant, reference, extra_time=_AFTER_FAULT if fault else AFTER)
    verdict = watched.verdict
    since = next((float(t) for t in run.time if broken.active(float(t))), 0.0) if fault else 0.0
    after = (run.time >= since) & ~_rests_for_good(run)
    return MonitorTrial(
        case=case,
        fault=fault,
        driven=float(run.time[-1]),
        rule=verdict.rule,
        words=verdict.words,
        after=verdict.at - since if verdict else math.nan,
        farthest=float(distances(run)[after].max(initial=0.0)),
        fastest=float(np.abs(run.true_twist[after, 0]).max(initial=0.0)),
        at_rest=bool(_rests_for_good(run)[-25:].all()),
        left=_largest_distance(run if not verdict else simulate(*build(case), extra_time=AFTER)) > LEFT,
    )


def _rests_for_good(run: Run) -> NDArray[np.bool_]:
    """(n,) whether the robot stands from an instant on; the reference may go on alone."""
    moves = np.abs(run.true_twist[:, [0, 2]]).max(axis=1) > _AT_REST
    return ~np.logical_or.accumulate(moves[::-1])[::-1]


def distances(run: Run, near: tuple[float, float] = _NEAR) -> FloatArray:
    """(n,) from the true position to the nearest place of the reference from `near[0]` ago to `near[1]` ahead [m]."""
    times = np.arange(-near[0], run.time[-1] + near[1], 0.05)
    places = run.reference.sample(times).pose[:, :2]
    first = np.searchsorted(times, run.time - near[0])
    last = np.searchsorted(times, run.time + near[1], "right")
    poses = run.true_pose[:, :2]
    away = [np.hypot(*(places[a:b] - pose).T).min() for a, b, pose in zip(first, last, poses, strict=True)]
    return np.array(away)


LEFT = 0.1
"""Distance beyond which the robot has left the stretch that its reference covers around now [m]."""
ON_TIME = 0.5
"""Time by which this stretch begins before now and ends after now [s]."""


def _largest_distance(run: Run) -> float:
    """From the stretch that the reference covers around each instant [m]."""
    return float(distances(run, (ON_TIME, ON_TIME)).max())
