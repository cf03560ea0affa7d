"""Costs of turns of a robot, identified from its log: `diffdrive-mpc torque`."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import numpy as np
import yaml
from matplotlib.axes import Axes

from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, new_figure
from diffdrive_mpc.bench.html_report.page import KeyFigure, Shown
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc_extras.costs_from_log.costs_from_log import PRIOR, LogOutcome, learn_log
from diffdrive_mpc_extras.turn_costs import Vehicle, turn_costs_text

_CURVE_RADII = np.geomspace(0.3, 300.0, 80)


def draw_log(outcome: LogOutcome, path: Path) -> None:
    """Draw torques by the currents of a log, and the curves learned from them."""
    with new_figure(path, 6.4, 3.8) as figure:
        axes = figure.subplots()
        radii, outer, inner = outcome.samples.T
        pairs = ((outer, outcome.curves.outer, "outer"), (inner, outcome.curves.inner, "inner"))
        for side, (values, prior, name) in enumerate(pairs):
            axes.plot(radii, values, ".", color=colour(side), markersize=1.5, alpha=0.25, rasterized=True)
            axes.plot(_CURVE_RADII, prior(_CURVE_RADII), color=colour(side), label=name)
        least = outcome.curves.least_radius()
        if 0 < least < np.inf:
            axes.axvline(least, color=colour(2), linestyle="-.", label=f"least radius {least:.2f} m")
        torque_axes(axes, outcome.vehicle, f"Torques by the motors' currents in {outcome.log.name}")
        axes.legend()


def torque_axes(axes: Axes, vehicle: Vehicle, title: str) -> None:
    """Label the axes of torques over radii, and draw the limits of the motors."""
    for sign in (1, -1):
        axes.axhline(sign * vehicle.torque_limit, color=REFERENCE_COLOUR, linewidth=0.8, linestyle="--")
    axes.axhline(0.0, color=REFERENCE_COLOUR, linewidth=0.8)
    axes.set(xscale="log", xlabel="commanded turn radius [m]", ylabel="torque [N m]", title=title)


DRIVE_FILE, COSTS_FILE = "drive.yaml", "turn-costs.yaml"

_RADII = np.geomspace(0.3, 300.0, 13)
_CONSTANTS = (
    ("torque_constant", "torque constant [N m/A]", 5),
    ("resistance", "resistance [ohm]", 4),
    ("idle_power", "power at rest [W]", 3),
)


class TorqueLogStudy(Study[None, LogOutcome]):
    """One log.

    Parameters
    ----------
    log, mapping, vehicle, drive
        As for `learn_log`.
    """

    name = "torque"
    title = "What a turn costs, from a log"

    def __init__(self, log: Path, mapping: str | None, vehicle: str, drive: str | None) -> None:
        self._asked = log, mapping, vehicle, drive

    def plan(self) -> None:
        """Return no plan: everything is in the files."""

    def run(self, plan: None, jobs: int, bar: ProgressBar) -> LogOutcome:
        """Read and learn; raises ConfigError as `learn_log`."""
        del plan, jobs
        bar.start_stage("learning", 1)
        return learn_log(*self._asked)

    def report(self, results: LogOutcome, seconds: float) -> Report:
        """Report tables, the figure and the two files."""
        least = results.costs.least_radius()
        shown = "none" if least == 0 else f"{number(least, 2)} m"
        source = f"Drive constants as given: {results.note}." if results.note else "Drive constants from the log."
        drive = results.drive.model_dump(mode="json")
        return Report(
            counted=f"{len(results.samples)} samples of steady turns",
            meta={"log": results.log.name, "vehicle": results.vehicle.name},
            content={
                "constants": {name: getattr(results.drive, name) for name, _, _ in _CONSTANTS},
                "deviations": None if results.identified is None else results.identified.deviation,
                "slip": None if results.slip is None else results.slip.named(),
                "least_radius_m": least,
                "measured_j": results.measured,
                "predicted_j": results.predicted,
            },
            facts=[
                f"Log {results.log.name}, vehicle '{results.vehicle.name}', in {seconds} s. {source} The curves began "
                f"with the terrain '{PRIOR}'; {results.slip_from}.",
                *(f"{finding.place}: {finding.words}." for finding in results.log.findings),
            ],
            notes=[
                "Energy: of turns no sharper than the least radius, and of rest; predicted by turn costs that were "
                "learned from this very log.",
            ],
            tables=_tables(results),
            figures={"learned.png": partial(draw_log, results)},
            shown=Shown(
                key_figures=[KeyFigure("least radius", shown, f"at {results.costs.curve.speed:g} m/s", "good")]
            ),
            files={
                DRIVE_FILE: yaml.safe_dump(drive, sort_keys=False, allow_unicode=True),
                COSTS_FILE: turn_costs_text(results.costs),
            },
        )


def _tables(results: LogOutcome) -> list[Table]:
    identified, speed = results.identified, results.costs.curve.speed
    constants = Table(
        "Drive constants",
        ("constant", "found", "standard deviation", "before"),
        tuple(
            (
                words,
                number(getattr(results.drive, name), digits),
                "as given" if identified is None else number(identified.deviation[name], digits),
                number(getattr(results.prior, name), digits),
            )
            for name, words, digits in _CONSTANTS
        ),
    )
    commands = np.stack([np.full_like(_RADII, speed), speed / _RADII], axis=-1)
    torques, power = results.costs.torques(commands), results.costs.power(commands)
    curve = Table(
        "Turns to the left",
        ("commanded radius [m]", "outer [N m]", "inner [N m]", "power [W]"),
        tuple(
            (number(radius, 2), number(outer, 2), number(inner, 2), number(watts, 1))
            for radius, (inner, outer), watts in zip(_RADII.tolist(), torques.tolist(), power.tolist(), strict=True)
        ),
        note=f"At {speed:g} m/s. Driven were radii of {number(float(results.samples[:, 0].min()), 2)} to "
        f"{number(float(results.samples[:, 0].max()), 1)} m; beyond them the curves are held.",
    )
    tables = [constants, curve]
    if results.slip is not None:
        rows = (
            (name, number(value, 4), number(deviation, 4))
            for (name, value), deviation in zip(
                results.slip.named().items(), results.slip.deviations.ravel().tolist(), strict=True
            )
        )
        tables.append(Table("Slip law", ("coefficient", "found", "standard deviation"), tuple(rows)))
    if math.isfinite(results.measured):
        off = 100 * (results.predicted / results.measured - 1) if results.measured else math.nan
        row = (number(results.measured, 1), number(results.predicted, 1), number(off, 1))
        tables.append(Table("Energy of the log", ("measured [J]", "predicted [J]", "off [%]"), (row,)))
    return tables
