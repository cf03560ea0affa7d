"""P4's torques and powers of steady turns, by its shear law on vinyl and on the simulated robot's smoothest floor.

P4: Ordonez et al., 2017, section 2.3, Figures 6 and 7. Its measured torques are in a figure only; beside the model
with its printed parameters stands the simulated robot of `torque/turn_study.yaml`.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.energy.power_readings import robot_power
from diffdrive_mpc_extras.planner import PlanError, plan
from diffdrive_mpc_extras.terrain import load_terrain, side_torques
from diffdrive_mpc_extras.torque.measurements import load_turn_study, plant_of, steady_turns
from diffdrive_mpc_extras.turn_costs import DriveConstants, Vehicle, load_turn_costs, load_vehicle
from studies.reproduce.published import PaperFinding, Published, TurningStudy

_SHOWN = (0.5, 2.0, 20.0, 1000.0)
_TORQUES = "P4, section 2.3, Figure 6"
_POWER = "P4, section 2.3, Figure 7"
_CHOSEN = " (no test: the drag, which is not printed, is chosen for this)"
_NOTE = (
    "Counter-clockwise, P4's radii. Shear law: with the parameters that P4 prints for vinyl. Power: torque times speed "
    "of the wheels and heat of the windings (equation 25), whose resistance P4 does not print. Commands of the robot "
    "end at 2 rad/s: at 0.6 m/s none is sharper than 0.3 m."
)


@dataclass(frozen=True)
class SteadyTurns:
    """Steady counter-clockwise turns at one speed, n radii.

    Attributes
    ----------
    source
        "shear law" or the name of the floor.
    speed
        Commanded [m/s].
    radius
        (n,) commanded, ascending [m].
    torque, power
        (n, 2) outer, inner: of a side [N m], electrical of a side [W].
    """

    source: str
    speed: float
    radius: FloatArray
    torque: FloatArray
    power: FloatArray

    @property
    def drives_beyond(self) -> float:
        """Radius from which on the inner side drives instead of braking [m]; NaN where it always does one of them."""
        inner = self.torque[:, 1]
        below = np.flatnonzero(inner < 0)
        if not below.size or below[-1] == len(inner) - 1:
            return float("nan")
        k = int(below[-1])
        share = inner[k] / (inner[k] - inner[k + 1])
        low, high = np.log(self.radius[k : k + 2])
        return float(np.exp(low + share * (high - low)))

    @property
    def gives_back(self) -> tuple[float, float] | None:
        """Least and greatest of the radii at which the inner side gives power back [m]; None where it never does."""
        back = self.radius[self.power[:, 1] < 0]
        return (float(back[0]), float(back[-1])) if back.size else None


@dataclass(frozen=True)
class TurningResult:
    """By P4's law on vinyl, and on the floor of the simulated robot; one for each speed.

    Attributes
    ----------
    law, driven
        The turns, speeds ascending.
    inner_forward_from
        Radius from which on the inner wheels turn forward, by the base's own kinematics [m].
    """

    law: tuple[SteadyTurns, ...]
    driven: tuple[SteadyTurns, ...]
    inner_forward_from: float


LAW = "shear law"


def turn_steadily(study: TurningStudy) -> TurningResult:
    """The paper's radii and speeds, by the law and driven."""
    torque_study = load_turn_study()
    vehicle, constants = robot_parts(torque_study.robot)
    vinyl, radii = load_terrain(torque_study.prior), np.array(study.radii)
    asked = torque_study.measured.model_copy(update={"settling": study.settling, "hold": study.hold})
    plant = plant_of(torque_study.robot, study.smooth_floor, sensors="perfect")
    track = vehicle.command_track or vehicle.track
    law, driven = [], []
    for speed in study.speeds:
        torques = side_torques(vehicle, vinyl, radii, speed)
        torque = np.stack([torques.outer, torques.inner], axis=-1)
        wheels = np.stack([torques.outer_speed, torques.inner_speed], axis=-1)
        law.append(SteadyTurns(LAW, speed, radii, torque, constants.side_power(torque, wheels)))
        turns = steady_turns(plant, study.radii, speed, asked, track)
        torque = np.stack([turns.outer, turns.inner], axis=-1)
        power = turns.power + constants.side_heating * torque**2
        driven.append(SteadyTurns(study.smooth_floor, speed, radii, torque, power))
    return TurningResult(tuple(law), tuple(driven), 0.5 * track)


def turning_table(result: TurningResult) -> Table:
    """Torques at some radii, and the radii at which the inner side changes what it does."""
    rows = []
    for one in (*result.law, *result.driven):
        cells = [
            "{}, {}".format(
                *(number(float(np.interp(np.log(r), np.log(one.radius), side)), 2) for side in one.torque.T)
            )
            for r in _SHOWN
        ]
        back = one.gives_back
        span = "nowhere" if back is None else "{} to {}".format(*(f"{r:g}" for r in back))
        rows.append((_name(one), f"{one.speed:g}", *cells, number(one.drives_beyond, 1), span))
    return Table(
        "Steady turns",
        (
            "torques of",
            "speed [m/s]",
            *(f"outer, inner at {r:g} m [N m]" for r in _SHOWN),
            "inner drives beyond [m]",
            "inner gives back power at [m]",
        ),
        tuple(rows),
        text_columns=1,
        note=_NOTE,
    )


def _name(turns: SteadyTurns) -> str:
    return "shear law, vinyl" if turns.source == LAW else f"robot on '{turns.source}'"


def turning_findings(result: TurningResult, published: Published) -> list[PaperFinding]:
    """What P4 reads from its Figures 6 and 7, one verdict for each speed."""
    printed, rules = published.turning, published.rules
    findings = [
        PaperFinding(
            f"the inner wheels turn forward beyond the printed radius, within {100 * rules.turn_radius_off:g} %",
            _TORQUES,
            f"half the track, {printed.inner_forward_from:g} m; its Table 1 has a track of 0.39 m",
            f"{result.inner_forward_from:.3f} m",
            (abs(result.inner_forward_from / printed.inner_forward_from - 1) < rules.turn_radius_off,),
        )
    ]
    for turns in (result.law, result.driven):
        where = f"{_name(turns[0])}; {', '.join(f'{turn.speed:g}' for turn in turns)} m/s"
        findings += [
            PaperFinding(
                f"torques grow as turns get sharper, to {100 * rules.turn_rise:g} % of the largest ({where})",
                _TORQUES,
                "seen in the figure",
                "; ".join(f"{turn.torque[-1, 0]:.2f} to {turn.torque[:, 0].max():.2f} N m" for turn in turns),
                tuple(_falls(turn, rules.turn_rise) for turn in turns),
            ),
            PaperFinding(
                f"the inner side drives beyond the printed radius, to a factor of {rules.turn_crossing:g} ({where})",
                _TORQUES,
                f"{printed.inner_drives_beyond:g} m",
                "; ".join(f"{turn.drives_beyond:.1f} m" for turn in turns) + (_CHOSEN if turns is result.law else ""),
                tuple(
                    bool(abs(np.log(turn.drives_beyond / printed.inner_drives_beyond)) < np.log(rules.turn_crossing))
                    for turn in turns
                ),
            ),
            _speed_does_not_matter(turns, where, rules.turn_alike, rules.turn_alike_from),
            PaperFinding(
                f"the inner side gives back power at some radii where it skids ({where})",
                _POWER,
                "seen in the figure",
                "; ".join("nowhere" if (b := turn.gives_back) is None else f"{b[0]:g} to {b[1]:g} m" for turn in turns),
                tuple(turn.gives_back is not None for turn in turns),
            ),
        ]
    return findings


def _falls(turns: SteadyTurns, rise: float) -> bool:
    """Whether the outer torque never rises by more than this share of the largest towards wider turns."""
    outer = turns.torque[:, 0]
    return bool((outer - np.minimum.accumulate(outer)).max() <= rise * outer.max())


def _speed_does_not_matter(turns: Sequence[SteadyTurns], where: str, alike: float, wider_than: float) -> PaperFinding:
    """The largest difference over the wider radii and both sides, over the largest torque there."""
    torques = np.array([turn.torque[turn.radius >= wider_than] for turn in turns])
    apart = float((torques.max(axis=0) - torques.min(axis=0)).max() / np.abs(torques).max())
    return PaperFinding(
        f"torques do not depend on the speed, to {100 * alike:g} % of the largest, from {wider_than:g} m on ({where})",
        _TORQUES,
        "little, but for very sharp turns",
        f"{100 * apart:.0f} % apart",
        (apart < alike,),
    )


# How long the planner takes beside P4's SBMPO: plans of least energy within 10 m by 10 m at 0.6 m/s, as there.


_AREA, _SPEED, _FROM = 10.0, 0.6, 6.0


def planning_times(costs: str, count: int, seed: int) -> tuple[float, ...]:
    """Processor times of `count` plans [s] with the turn costs of that name, each from a corner to a goal ahead.

    The heading at the goal is that of the straight line, turned by up to a quarter of a circle. A goal that cannot be
    planned takes its time, too.
    """
    rng, robot, took = np.random.default_rng(seed), load_turn_costs(costs), []
    for _ in range(count):
        goal = rng.uniform([_FROM, 0.0], _AREA)
        heading = math.atan2(goal[1], goal[0]) + rng.uniform(-math.pi / 4, math.pi / 4)
        begin = time.process_time()
        with contextlib.suppress(PlanError):
            plan(robot, [0.0, 0.0, 0.0], [*goal, heading], minimise="energy", speed=_SPEED)
        took.append(time.process_time() - begin)
    return tuple(took)


def robot_parts(robot: str) -> tuple[Vehicle, DriveConstants]:
    """Return vehicle and motors of a simulated robot; raises ConfigError where one does not exist."""
    return load_vehicle(robot), robot_power(f"mujoco:{robot}").drive
