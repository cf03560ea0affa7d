"""The torque study: what a turn costs the simulated robot, and how much of it can be known beforehand."""

from __future__ import annotations

from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np

from diffdrive_mpc.bench.html_report.page import KeyFigure, Shown
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import run_tasks
from diffdrive_mpc.bench.study import Draw, Report, Study
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.terrain import load_terrain
from diffdrive_mpc_extras.turn_costs import turn_costs_text
from studies.torque.measurements import plant_of
from studies.torque.outcome import (
    CLOSE,
    FloorOutcome,
    PayloadOutcome,
    measure_floor,
    measure_payload,
    parts_of,
    reference_speed,
    rms_error,
)
from studies.torque.settings import TorqueStudySettings

# What is asked of it: seconds of driving, and shares.
_IN_TIME, _RADIUS_WITHIN, _ENERGY_WITHIN = 90.0, 0.20, 0.10


class TorqueResults(NamedTuple):
    """What was found."""

    floors: list[FloorOutcome]
    payloads: list[PayloadOutcome]


class TorqueStudy(Study[TorqueStudySettings, TorqueResults]):
    """Floors one after the other, then payloads on one of them.

    Parameters
    ----------
    settings
        What to do.
    """

    name = "torque"
    title = "Torque, least turn radius and energy of turns"

    def __init__(self, settings: TorqueStudySettings) -> None:
        self._settings = settings

    def plan(self) -> TorqueStudySettings:
        """The settings; raises ConfigError if a robot, floor or terrain does not exist."""
        asked = self._settings
        parts_of(asked)
        load_terrain(asked.prior).known_shear()
        for surface in (*asked.surfaces, asked.payload_surface):
            plant_of(asked.robot, surface)
        return asked

    def run(self, plan: TorqueStudySettings, jobs: int, bar: ProgressBar) -> TorqueResults:
        """Measure every floor, and every payload."""
        bar.begin("floors", len(plan.surfaces))
        floors = run_tasks([partial(measure_floor, plan, name) for name in plan.surfaces], jobs, bar.advance)
        bar.begin("payloads", len(plan.payloads))
        payloads = run_tasks([partial(measure_payload, plan, mass) for mass in plan.payloads], jobs, bar.advance)
        return TorqueResults(floors, payloads)

    def report(self, results: TorqueResults, seconds: float) -> Report:
        """Tables and figures."""
        from studies.torque import figures  # noqa: PLC0415 - matplotlib

        asked, speed = self._settings, reference_speed()
        vehicle, constants = parts_of(asked)
        draws: dict[str, Draw] = {}
        for floor in results.floors:
            draws[f"torque-{floor.surface}.png"] = partial(figures.draw_torques, floor, vehicle)
            draws[f"learned-{floor.surface}.png"] = partial(figures.draw_learned, floor, vehicle, speed)
        draws["power.png"] = partial(figures.draw_power, results.floors, vehicle, constants, load_terrain(asked.prior))
        draws["learning.png"] = partial(figures.draw_learning, results.floors)
        if results.payloads:
            draws["payloads.png"] = partial(figures.draw_payloads, results.payloads)
        draws["energy.png"] = partial(figures.draw_energy, results.floors)
        driven = len(asked.diagnostic.radii) * asked.diagnostic.hold
        return Report(
            counted=f"{len(results.floors)} floors, {len(results.payloads)} payloads",
            meta={"robot": asked.robot, "prior": asked.prior, "speed_m_s": speed, "diagnostic_drive_s": driven},
            content=_content(results, speed),
            facts=[
                f"Robot '{asked.robot}' in the physics, in {seconds} s; diagnostic drive of {driven:g} s; curves stand "
                f"at {speed:g} m/s; the networks begin with the terrain '{asked.prior}'."
            ],
            notes=[
                "RMSE: of the learned torques against steady turns of the same robot, over the RMS of the measured "
                "curve, the worse of the two sides.",
                "Least radius, own: the largest at which the outer motors give 95 % of their limit, by bisection; not "
                "kept: the largest at which the wheels turn the robot by less than 90 % of what was commanded.",
                "Energy: measured from the true torque and speed of each motor in each step of the physics; predicted "
                "from commands, learned curves and the base's own wheel speeds.",
            ],
            tables=_tables(results, speed),
            figures=draws,
            shown=Shown(key_figures=_key_figures(results, speed)),
            files={f"turn-costs-{floor.surface}.yaml": turn_costs_text(floor.costs) for floor in results.floors},
        )


def _key_figures(results: TorqueResults, speed: float) -> list[KeyFigure]:
    """The worst of each, and whether it is within what is asked: 10 % in 90 s, 20 %, 10 %."""
    floors = results.floors
    learned = max(max(rms_error(floor.learned, floor.steady[speed], speed)) for floor in floors)
    after = max(floor.close_after for floor in floors)
    radii = [abs(floor.model_radius / floor.own_radius[0] - 1) for floor in floors if floor.own_radius[0]]
    energies = [abs(energy.error) for floor in floors for energy in floor.energies]
    return [
        _share("torque after learning", learned, CLOSE, "off, at most (RMSE)"),
        KeyFigure("learned within", f"{number(after, 0)} s", f"to {100 * CLOSE:g} %", _state(after < _IN_TIME)),
        *([_share("least radius by the model", max(radii), _RADIUS_WITHIN, "off, at most")] if radii else []),
        *([_share("energy of unseen drives", max(energies), _ENERGY_WITHIN, "off, at most")] if energies else []),
    ]


def _share(label: str, value: float, most: float, note: str) -> KeyFigure:
    return KeyFigure(label, f"{number(100 * value, 1)} %", f"{note}; asked: {100 * most:g} %", _state(value < most))


def _state(good: bool) -> Literal["good", "bad"]:
    return "good" if good else "bad"


def _tables(results: TorqueResults, speed: float) -> list[Table]:
    floors = [((floor.surface,), floor) for floor in results.floors]
    learning = Table.of(
        "Torque learned",
        ("floor",),
        {
            "prior, RMSE [%]": lambda row: number(100 * max(rms_error(row.prior, row.steady[speed], speed)), 1),
            "learned [%]": lambda row: number(100 * max(rms_error(row.learned, row.steady[speed], speed)), 1),
            "by radius alone [%]": lambda row: number(100 * row.learned_by_radius, 1),
            f"below {100 * CLOSE:g} % after [s]": lambda row: number(row.close_after, 0),
            "units": lambda row: "{} + {}".format(*row.learned.units),
        },
        floors,
    )
    radius = Table.of(
        "Least radius",
        ("floor",),
        {
            "own, by torque [m]": lambda row: radius_text(row.own_radius[0]),
            "own, not kept [m]": lambda row: radius_text(row.own_radius[1]),
            "model [m]": lambda row: radius_text(row.model_radius),
            "off [%]": lambda row: _off(row.model_radius, row.own_radius[0]),
            "learned [m]": lambda row: radius_text(row.learned_radius),
            "learned off [%]": lambda row: _off(row.learned_radius, row.own_radius[0]),
        },
        floors,
        note="Model: shear law fitted to steady turns at radii held out from the curve.",
    )
    terrain = Table.of(
        "Terrain found",
        ("floor", "from"),
        {
            "mu": lambda row: number(row.shear.mu_outer, 3),
            "K [mm]": lambda row: number(1e3 * row.shear.modulus, 3),
            "RMS [N m]": lambda row: number(row.rms, 3),
            "not told": lambda row: ", ".join(row.untold) or "-",
        },
        [
            ((floor.surface, source), estimate)
            for floor in results.floors
            for source, estimate in (("steady turns", floor.fitted), ("learned curves", floor.mapped))
        ],
    )
    energy = Table.of(
        "Energy of unseen drives",
        ("floor",),
        {
            "seed": lambda pair: str(pair.seed),
            "measured [J]": lambda pair: number(pair.measured, 1),
            "predicted [J]": lambda pair: number(pair.predicted, 1),
            "off [%]": lambda pair: number(100 * pair.error, 1),
            "by the prior [%]": lambda pair: number(100 * (pair.by_prior / pair.measured - 1), 1),
        },
        [((floor.surface,), energy) for floor in results.floors for energy in floor.energies],
    )
    payload = Table.of(
        "Payload",
        ("payload [kg]",),
        {
            "terrain, outer RMSE [%]": lambda row: number(100 * _payload_error(row, 0, row.predicted), 1),
            "inner [%]": lambda row: number(100 * _payload_error(row, 1, row.predicted), 1),
            "curves as learned, outer [%]": lambda row: number(100 * _payload_error(row, 0, row.learned), 1),
            "inner, as learned [%]": lambda row: number(100 * _payload_error(row, 1, row.learned), 1),
        },
        [((f"{payload.payload:g}",), payload) for payload in results.payloads],
        note="From the diagnostic drive without payload: the terrain that its curves were mapped to, and the curves.",
    )
    return [learning, radius, terrain, payload, energy]


def _content(results: TorqueResults, speed: float) -> dict[str, object]:
    rows: list[dict[str, Any]] = [
        {
            "surface": floor.surface,
            "prior_rmse": max(rms_error(floor.prior, floor.steady[speed], speed)),
            "learned_rmse": max(rms_error(floor.learned, floor.steady[speed], speed)),
            "learned_by_radius_rmse": floor.learned_by_radius,
            "close_after_s": floor.close_after,
            "own_least_radius_m": floor.own_radius[0],
            "own_not_kept_radius_m": floor.own_radius[1],
            "model_least_radius_m": floor.model_radius,
            "learned_least_radius_m": floor.learned_radius,
            "fitted": floor.fitted.shear.model_dump(),
            "mapped": floor.mapped.shear.model_dump(),
            "energies": [dict(energy._asdict(), error=energy.error) for energy in floor.energies],
            "slip": floor.slip.named(),
            "slip_deviation": dict(zip(floor.slip.named(), floor.slip.deviations.ravel().tolist(), strict=True)),
            "slip_rms": floor.slip.rms.tolist(),
        }
        for floor in results.floors
    ]
    turns = [
        {"surface": floor.surface, "speed_m_s": v, "radius_m": r, "outer_n_m": o, "inner_n_m": i, "kept": kept}
        for floor in results.floors
        for v, steady in floor.steady.items()
        for r, o, i, kept in zip(*(column.tolist() for column in steady[:4]), strict=True)
    ]
    payloads = [
        {
            "payload_kg": payload.payload,
            "terrain_rmse": [_payload_error(payload, side, payload.predicted) for side in (0, 1)],
            "as_learned_rmse": [_payload_error(payload, side, payload.learned) for side in (0, 1)],
        }
        for payload in results.payloads
    ]
    return {"floors": rows, "payloads": payloads, "turns": turns}


def _payload_error(outcome: PayloadOutcome, side: int, estimate: FloatArray) -> float:
    """RMSE over the RMS of the measured curve [-]."""
    true = (outcome.steady.outer, outcome.steady.inner)[side]
    return float(np.sqrt(np.mean((estimate[:, side] - true) ** 2) / np.mean(true**2)))


def radius_text(value: float) -> str:
    """A least radius [m] for a table."""
    return "none" if value == 0 else number(value, 2)


def _off(value: float, own: float) -> str:
    if value == 0 or own == 0:
        return "-" if value == own else "one of them"
    return number(100 * (value / own - 1), 1)
