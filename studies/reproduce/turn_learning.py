"""P4's torque curves learned while driving, the least radius that they tell, and the energy that they foresee.

P4: Ordonez et al., 2017, sections 4.2 and 4.3, Figures 16 to 19 and 25. Of its asphalt, concrete and grass slip laws
and least radii are printed, torques of asphalt only; floors of the simulated robot stand in for them.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.plants.open_loop import OpenLoopDrive, drive_open_loop
from diffdrive_mpc_extras.energy import predict_energy
from diffdrive_mpc_extras.terrain import load_terrain
from diffdrive_mpc_extras.torque import TorqueCurves, load_torque_settings
from diffdrive_mpc_extras.torque.measurements import (
    Steady,
    diagnostic_drive,
    load_turn_study,
    own_least_radius,
    plant_of,
    sides,
    steady_turns,
    unseen_commands,
)
from diffdrive_mpc_extras.turn_costs import LIMIT_SHARE, DriveConstants
from studies.reproduce.published import PaperFinding, Published, TurningStudy
from studies.reproduce.turning import planning_times, robot_parts

_RADII = np.geomspace(0.3, 300.0, 80)
_CURVES = "P4, section 4.2, Figures 16 to 18"
_ENERGY = "P4, section 4.3, Figures 19 and 25"
_LEAST_NOTE = (
    "Raw torques: widest turn of the drive with the outer side at its limit, of 24 radii, here at 0.4 m/s or what is "
    "the same. Off: P4's from its raw torques, ours from steady turns. P4's text says 1.8 m for grass, its Table 3 and "
    "Figure 18 say 1.2 m."
)
_ENERGY_NOTE = (
    "Missed: measured less foreseen over measured; negative where too much was foreseen, as P4 counts. Each drive goes "
    "at 0.2 to 0.6 m/s through turns that were not learned from."
)


@dataclass(frozen=True)
class EnergyRun:
    """A drive that was not learned from; energies over its n samples [J].

    Attributes
    ----------
    seed
        It was drawn from.
    time
        (n,) [s].
    measured, learned, prior
        (n,) energy so far: of the true torques, by the learned curves, by those of vinyl.
    """

    seed: int
    time: FloatArray
    measured: FloatArray
    learned: FloatArray
    prior: FloatArray

    def missed(self, by: FloatArray) -> float:
        """Measured less foreseen energy over the measured one [-]: negative where too much was foreseen, as in P4."""
        return float(1 - by[-1] / self.measured[-1])


@dataclass(frozen=True)
class LearnedTurns:
    """What the diagnostic drive taught on one floor, from the curves of vinyl.

    Attributes
    ----------
    floor
        Its name.
    limit
        Largest torque of a side [N m].
    raw
        (k, 7) of each command of the drive once it was held: radius at the speed of the curves [m], then least, mean
        and largest torque of the outer and of the inner side [N m].
    radius
        (n,) at which the curves are given [m].
    learned, prior
        (n, 2) outer, inner [N m].
    off
        RMSE of outer and inner side, over the RMS of steady turns [-].
    own, raw_least, learned_least, prior_least
        Least radius [m], 0 for none: in steady turns, of the raw torques, of the curves.
    runs
        Drives that were not learned from.
    learning_time
        Processor time of taking in one sample, both networks [s].
    planning_times
        Of `turn_plans.planning_times` [s].
    """

    floor: str
    limit: float
    raw: FloatArray
    radius: FloatArray
    learned: FloatArray
    prior: FloatArray
    off: tuple[float, float]
    own: float
    raw_least: float
    learned_least: float
    prior_least: float
    runs: tuple[EnergyRun, ...]
    learning_time: float
    planning_times: tuple[float, ...]


def learn_turns(study: TurningStudy, floor: str) -> LearnedTurns:
    """Drive, learn, and foresee drives that were not learned from."""
    asked = load_turn_study()
    vehicle, constants = robot_parts(asked.robot)
    speed, track = load_torque_settings().curves.speed, vehicle.command_track or vehicle.track
    measured = asked.measured.model_copy(update={"settling": study.settling, "hold": study.hold})
    still = plant_of(asked.robot, floor, sensors="perfect")
    drive = diagnostic_drive(plant_of(asked.robot, floor, seed=asked.seed), asked.diagnostic)
    prior, learned = (TorqueCurves.from_prior(vehicle, load_terrain(asked.prior)) for _ in range(2))
    begin = time.process_time()
    used = learned.learn_drive(drive.command, *sides(drive.motor_torque), still.sample_time)
    took = (time.process_time() - begin) / used
    raw = _raw(drive, still.sample_time)
    saturated = raw[raw[:, 2] > LIMIT_SHARE * vehicle.torque_limit, 0]
    unseen = asked.unseen.model_copy(update={"turns": study.turns})
    runs = []
    for seed in study.seeds:
        commands = unseen_commands(unseen, seed, still.sample_time, learned.least_radius(max(unseen.speeds)))
        driven = drive_open_loop(plant_of(asked.robot, floor, seed=asked.seed), commands)
        measured_power = true_power(driven, constants)
        by_learned, by_prior = (
            predict_energy(vehicle, constants, curves, commands, still.sample_time).power for curves in (learned, prior)
        )
        ends = np.asarray(np.arange(1, len(commands) + 1) * still.sample_time)
        energies = [np.cumsum(power) * still.sample_time for power in (measured_power, by_learned, by_prior)]
        runs.append(EnergyRun(seed, ends, *energies))
    after, before = (np.stack([curves.outer(_RADII), curves.inner(_RADII)], axis=-1) for curves in (learned, prior))
    return LearnedTurns(
        floor,
        vehicle.torque_limit,
        raw,
        _RADII,
        after,
        before,
        rms_error(learned, steady_turns(still, asked.measured.radii, speed, measured, track), speed),
        own_least_radius(still, speed, measured, vehicle.torque_limit, track)[0],
        float(saturated.max()) if saturated.size else 0.0,
        learned.least_radius(),
        prior.least_radius(),
        tuple(runs),
        took,
        planning_times(f"{asked.robot}-{floor}", study.plans, study.seeds[0]),
    )


def _raw(drive: OpenLoopDrive, sample_time: float) -> FloatArray:
    """(k, 7) as `LearnedTurns.raw`."""
    settings = load_torque_settings().curves
    left, right = sides(drive.motor_torque)
    begins = np.flatnonzero(np.append(True, np.any(np.diff(drive.command, axis=0) != 0, axis=1)))
    rows = []
    for first, stop in zip(begins, np.append(begins[1:], len(drive.command)), strict=True):
        v, omega = drive.command[first]
        held = slice(first + round(settings.settling / sample_time), stop)
        pair = (right[held], left[held]) if omega > 0 else (left[held], right[held])
        radius = abs(v / omega) * (settings.speed / v) ** settings.speed_exponent
        rows.append([radius, *(value for side in pair for value in (side.min(), side.mean(), side.max()))])
    return np.array(rows)


def turn_learning_tables(floors: Sequence[LearnedTurns], published: Published) -> list[Table]:
    """Least radii, energies of drives that were not learned from, and what learning costs."""
    printed = published.turning
    least = [
        (
            f"P4, {name}",
            number(printed_radius.raw, 2),
            "-",
            number(printed_radius.network, 1),
            _percent(printed_radius.network / printed_radius.raw - 1),
            "-",
        )
        for name, printed_radius in printed.least_radius.items()
    ]
    least += [
        (
            f"robot on '{floor.floor}'",
            _metres(floor.raw_least),
            _metres(floor.own),
            _metres(floor.learned_least),
            _percent(floor.learned_least / floor.own - 1) if floor.own else "-",
            f"{100 * max(floor.off):.1f}",
        )
        for floor in floors
    ]
    runs = [
        (f"P4, {name}, mean", "-", "-", number(printed_share.learned, 1), number(printed_share.prior, 1))
        for name, printed_share in printed.energy_missed.items()
    ]
    for floor in floors:
        runs += [
            (
                floor.floor,
                str(run.seed),
                number(run.measured[-1], 1),
                _percent(run.missed(run.learned)),
                _percent(run.missed(run.prior)),
            )
            for run in floor.runs
        ]
        learned, prior = _means(floor)
        runs.append((f"{floor.floor}, mean", "-", "-", _percent(learned), _percent(prior)))
    cost = printed.cost
    took = float(np.mean([floor.learning_time for floor in floors]))
    plans = [duration for floor in floors for duration in floor.planning_times]
    return [
        Table(
            "Least radius learned",
            ("floor", "raw torques [m]", "steady turns [m]", "learned [m]", "learned, off [%]", "curve, RMSE [%]"),
            tuple(least),
            text_columns=1,
            note=_LEAST_NOTE,
        ),
        Table(
            "Energy foreseen",
            ("floor", "drawn from", "measured [J]", "learned, missed [%]", "vinyl, missed [%]"),
            tuple(runs),
            text_columns=2,
            note=_ENERGY_NOTE,
        ),
        Table(
            "Cost of learning",
            ("what", "published [ms]", "here [ms]"),
            (
                ("one sample into both networks (MRAN)", number(1e3 * cost.mran, 2), number(1e3 * took, 2)),
                ("one pose into the slip filter (IPEM)", number(1e3 * cost.ipem, 1), "-"),
                ("a plan on 10 m by 10 m (SBMPO)", number(1e3 * cost.sbmpo, 0), f"{1e3 * np.mean(plans):.0f}"),
            ),
            text_columns=1,
            note="Processor time on the machine named above, in Python; P4 names no machine. A plan: mean over "
            f"{len(plans)} of least energy at 0.6 m/s without obstacles, found and polished. '-': not measured here.",
        ),
    ]


def _means(floor: LearnedTurns) -> tuple[float, float]:
    """Mean over the runs of what was missed, by the learned curves and by those of vinyl."""
    pairs = [(run.missed(run.learned), run.missed(run.prior)) for run in floor.runs]
    learned, prior = np.mean(pairs, axis=0)
    return float(learned), float(prior)


def _metres(value: float) -> str:
    return "none" if value == 0 else number(value, 2)


def _percent(value: float) -> str:
    return number(100 * value, 1)


def turn_learning_findings(floors: Sequence[LearnedTurns], published: Published) -> list[PaperFinding]:
    """What P4 concludes from its curves and energies, one verdict for each floor."""
    printed, rules = published.turning, published.rules
    where, within = ", ".join(floor.floor for floor in floors), 100 * rules.turn_least_radius_off
    radii = "; ".join(
        f"{printed_radius.network:g} m of {printed_radius.raw:g}" for printed_radius in printed.least_radius.values()
    )
    ours = "; ".join(f"{_metres(floor.learned_least)} m of {_metres(floor.own)}" for floor in floors)
    energies = ", ".join(f"{name} {printed_share.learned:g} %" for name, printed_share in printed.energy_missed.items())
    without = ", ".join(f"{name} {printed_share.prior:g} %" for name, printed_share in printed.energy_missed.items())
    means = [_means(floor) for floor in floors]
    shares = "; ".join(_percent(learned) for learned, _ in means) + " %"
    return [
        PaperFinding(
            f"the curves of vinyl know no least radius, the learned ones do ({where})",
            _CURVES,
            "1.8, 2.4, 1.2 m from none",
            "; ".join(f"{_metres(floor.learned_least)} m from {_metres(floor.prior_least)}" for floor in floors),
            tuple(floor.prior_least == 0 < floor.learned_least for floor in floors),
        ),
        PaperFinding(
            f"learned torques are within {100 * rules.turn_torque_off:g} % of the measured ones (RMSE; {where})",
            _CURVES,
            "close to the average, by the figures",
            "; ".join(f"{100 * max(floor.off):.1f} %" for floor in floors),
            tuple(max(floor.off) < rules.turn_torque_off for floor in floors),
        ),
        PaperFinding(
            f"the learned least radius is within {within:g} % of that of steady turns ({where})",
            _CURVES,
            radii,
            ours,
            tuple(
                bool(floor.own) and abs(floor.learned_least / floor.own - 1) < rules.turn_least_radius_off
                for floor in floors
            ),
        ),
        PaperFinding(
            f"the learned least radius is not below the widest turn whose raw torques were at the limit ({where})",
            _CURVES,
            radii,
            "; ".join(f"{_metres(floor.learned_least)} m of {_metres(floor.raw_least)}" for floor in floors),
            tuple(floor.learned_least >= floor.raw_least for floor in floors),
        ),
        PaperFinding(
            f"nor below that of steady turns ({where})",
            "ours",
            "-",
            ours,
            tuple(floor.learned_least >= floor.own for floor in floors),
        ),
        PaperFinding(
            f"with learning the energy of each unseen drive is foreseen nearer than by vinyl ({where})",
            _ENERGY,
            f"missed: {energies}; without: {without}",
            "missed: " + "; ".join(f"{_percent(learned)} %, without {_percent(prior)} %" for learned, prior in means),
            tuple(
                all(abs(run.missed(run.learned)) < abs(run.missed(run.prior)) for run in floor.runs) for floor in floors
            ),
        ),
        PaperFinding(
            f"with learning too much energy is foreseen, which is the safe side (mean; {where})",
            _ENERGY,
            f"missed: {energies}",
            f"missed: {shares}",
            tuple(learned < 0 for learned, _ in means),
        ),
    ]


def rms_error(curves: TorqueCurves, steady: Steady, speed: float) -> tuple[float, float]:
    """Return the RMSE of outer and inner side over the RMS of each measured curve [-]."""
    pairs = ((curves.outer(steady.radius, speed), steady.outer), (curves.inner(steady.radius, speed), steady.inner))
    outer, inner = (float(np.sqrt(np.mean((estimate - true) ** 2) / np.mean(true**2))) for estimate, true in pairs)
    return outer, inner


def true_power(drive: OpenLoopDrive, constants: DriveConstants) -> FloatArray:
    """Return the power of the battery in each sample (K,) [W], from what each motor did."""
    return np.asarray(constants.motor_power(drive.motor_power, drive.motor_square).sum(axis=1) + constants.idle_power)
