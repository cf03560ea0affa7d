"""Study of `diffdrive-mpc torque`: energy costs of a robot's turns, identified from a log."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import numpy as np
import yaml
from matplotlib.axes import Axes

from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, new_figure
from diffdrive_mpc.bench.html_report.page import KeyFigure, PageContents
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc_extras.costs_from_log.costs_from_log import PRIOR, LogOutcome, learn_log
from diffdrive_mpc_extras.turn_costs import Vehicle, turn_costs_text

_CURVE_RADII = np.geomspace(0.3, 300.0, 80)


def draw_log(outcome: LogOutcome, path: Path) -> None:
    """Draw the torques that follow from the motor currents of a log, and the learned curves."""
    with new_figure(path, 6.4, 3.8) as figure:
        axes = figure.subplots()
        radii, outer, inner = outcome.samples.T
        pairs = ((outer, outcome.curves.outer, "outer"), (inner, outcome.curves.inner, "inner"))
        for side, (values, curve, name) in enumerate(pairs):
            axes.plot(radii, values, ".", color=colour(side), markersize=1.5, alpha=0.25, rasterized=True)
            axes.plot(_CURVE_RADII, curve(_CURVE_RADII), color=colour(side), label=name)
        min_radius = outcome.curves.least_radius()
        if 0 < min_radius < np.inf:
            axes.axvline(min_radius, color=colour(2), linestyle="-.", label=f"minimum radius {min_radius:.2f} m")
        _label_axes(axes, outcome.vehicle, f"Torques from the motor currents in {outcome.log.name}")
        axes.legend()


def _label_axes(axes: Axes, vehicle: Vehicle, title: str) -> None:
    """Label axes of torque over radius, and draw the torque limits."""
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
    """Study of one log.

    Parameters
    ----------
    log, mapping, vehicle, drive
        As for `learn_log`.
    """

    name = "torque"
    title = "Energy costs of turns, from a log"

    def __init__(self, log: Path, mapping: str | None, vehicle: str, drive: str | None) -> None:
        self._arguments = log, mapping, vehicle, drive

    def plan(self) -> None:
        """Return None: the study has no plan."""

    def run(self, plan: None, jobs: int, bar: ProgressBar) -> LogOutcome:
        """Learn from the log; raise ConfigError as `learn_log` does."""
        del plan, jobs
        bar.start_stage("learning", 1)
        return learn_log(*self._arguments)

    def report(self, results: LogOutcome, seconds: float) -> Report:
        """Report the tables, the figure, the drive constants and the turn costs."""
        min_radius = results.costs.least_radius()
        radius_text = "none" if min_radius == 0 else f"{number(min_radius, 2)} m"
        source = f"Drive constants as given: {results.note}." if results.note else "Drive constants from the log."
        drive = results.drive.model_dump(mode="json")
        return Report(
            size=f"{len(results.samples)} samples of steady turns",
            meta={"log": results.log.name, "vehicle": results.vehicle.name},
            content={
                "constants": {name: getattr(results.drive, name) for name, _, _ in _CONSTANTS},
                "deviations": None if results.identified is None else results.identified.deviation,
                "slip": None if results.slip is None else results.slip.named(),
                "least_radius_m": min_radius,
                "measured_j": results.measured,
                "predicted_j": results.predicted,
            },
            facts=[
                f"Log {results.log.name}, vehicle '{results.vehicle.name}', in {seconds} s. {source} Initial curves: "
                f"terrain '{PRIOR}'; {results.slip_source}.",
                *(f"{finding.place}: {finding.message}." for finding in results.log.findings),
            ],
            notes=[
                "Energy at rest and in turns of at least the minimum radius. The prediction uses turn costs learned "
                "from the same log.",
            ],
            tables=_tables(results),
            figures={"learned.png": partial(draw_log, results)},
            shown=PageContents(
                key_figures=[KeyFigure("minimum radius", radius_text, f"at {results.costs.curve.speed:g} m/s", "good")]
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
        ("constant", "identified", "standard deviation", "initial"),
        tuple(
            (
                label,
                number(getattr(results.drive, name), digits),
                "as given" if identified is None else number(identified.deviation[name], digits),
                number(getattr(results.prior, name), digits),
            )
            for name, label, digits in _CONSTANTS
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
        note=f"At {speed:g} m/s. The log has radii of {number(float(results.samples[:, 0].min()), 2)} to "
        f"{number(float(results.samples[:, 0].max()), 1)} m; the curves are constant outside this range.",
    )
    tables = [constants, curve]
    if results.slip is not None:
        rows = (
            (name, number(value, 4), number(deviation, 4))
            for (name, value), deviation in zip(
                results.slip.named().items(), results.slip.deviations.ravel().tolist(), strict=True
            )
        )
        tables.append(Table("Slip law", ("coefficient", "identified", "standard deviation"), tuple(rows)))
    if math.isfinite(results.measured):
        error = 100 * (results.predicted / results.measured - 1) if results.measured else math.nan
        row = (number(results.measured, 1), number(results.predicted, 1), number(error, 1))
        tables.append(Table("Energy of the log", ("measured [J]", "predicted [J]", "error [%]"), (row,)))
    return tables
