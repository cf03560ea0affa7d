"""SSM of several orders, identified from one long free drive (Guffanti, Pavon, Sensors 2025, 25(18), 5821)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.doubt import lines
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.load import load_linear_model
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.state_space import LinearSystem
from diffdrive_mpc.models.output_error.validation import validate
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.structures.orders import OrderRow
from diffdrive_mpc.models.structures.ssm import choose_order, identify_ssm
from diffdrive_mpc.models.velocity_model import VelocityModel
from studies.reproduce.drives import QUANTITIES, STATISTICS, PathError, RobotLogs, discretise, pose_error, predict_path
from studies.reproduce.published import PaperFinding, Published, SsmStudy, as_flags

PAPERS_ORDER = 2
"""Order of the SSM that the paper selects."""
IDENTIFIED, PRINTED = "identified", "as printed"
"""Names of two SSM of this order: identified from a simulated drive, and with the matrices of the paper."""

_TABLE = "P1, Table 1"
_SLIGHTLY_HIGHER = (3, 4)
_MAX_ORDER = 5
FIT_COLUMNS = ("FIT v [%]", "FIT omega [%]", "RMSE v [m/s]", "RMSE omega [rad/s]")
"""Headings of `VelocityFit.values`."""
_PUBLISHED = "published"
_FAST = "fast free drives"
_DIGITS = {True: (2, 2, 2, 2), False: (2, 2, 4, 4)}
"""Decimal places of FIT and RMSE of v and omega; the key is True for values of the paper."""

Pair = tuple[float, float]
"""Values for v and omega."""


@dataclass(frozen=True)
class VelocityFit:
    """FIT [%] and RMSE [m/s, rad/s] of a simulation from commands without measurements."""

    fit_percent: Pair
    rmse: Pair

    @property
    def values(self) -> list[float]:
        """FIT of v and omega, RMSE of v and omega."""
        return [*self.fit_percent, *self.rmse]


@dataclass(frozen=True)
class OrderResult:
    """Errors of one order; `bic` is Schwarz's information criterion minus the minimum of all orders."""

    order: int
    train: VelocityFit
    test: VelocityFit
    bic: float
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class FreeDrive:
    """Errors of a model on one validation drive."""

    velocity: VelocityFit
    odometry: PathError

    @property
    def values(self) -> list[float]:
        """FIT and RMSE of v and omega, then the statistics of position and heading (12 values)."""
        return [*self.velocity.values, *self.odometry.position.statistics, *self.odometry.heading.statistics]


@dataclass(frozen=True)
class SsmResult:
    """Errors of all orders for one repetition, the chosen order with the reason, and errors on free drives by model.

    `full_range` contains errors on free drives with the speed range of the paper, of an SSM that is identified from
    such a drive.
    """

    repetition: int
    orders: tuple[OrderResult, ...]
    chosen: int
    reason: str
    free_drives: Mapping[str, tuple[FreeDrive, ...]]
    full_range: Mapping[str, tuple[FreeDrive, ...]]


def compare_orders(study: SsmStudy, repetition: int) -> SsmResult:
    """Identify an SSM of every order from one free drive, choose an order, and predict other drives."""
    logs = RobotLogs(repetition)
    train = logs.free(1, study.train_duration)
    test = logs.free(study.test_drives, study.free_duration)
    choice = choose_order(train, test, max_order=study.max_order, limits=False)
    drives = logs.free(study.free_drives, study.free_duration)
    identified = choice.rows[PAPERS_ORDER - 1].identified
    fast = identify_ssm(logs.free(1, study.train_duration, study.paper_range), PAPERS_ORDER, limits=False)
    fast_drives = logs.free(study.free_drives, study.free_duration, study.paper_range)
    return SsmResult(
        repetition,
        tuple(_order_result(number, row, train, test) for number, row in enumerate(choice.rows, start=1)),
        choice.order,
        choice.reason,
        _predict_drives(identified, drives),
        _predict_drives(fast, fast_drives),
    )


def _predict_drives(identified: IdentifiedModel, drives: Sequence[Record]) -> dict[str, tuple[FreeDrive, ...]]:
    systems = {IDENTIFIED: identified.system, PRINTED: published_system(load_linear_model("ssm"))}
    return {name: tuple(free_drive(system, drive) for drive in drives) for name, system in systems.items()}


def _order_result(number: int, row: OrderRow, train: Sequence[Record], test: Sequence[Record]) -> OrderResult:
    identified: IdentifiedModel = row.identified
    return OrderResult(
        number,
        _velocity_fit(identified.system, train),
        _velocity_fit(identified.system, test),
        row.bic,
        lines(identified.warnings),
    )


def free_drive(system: LinearSystem, drive: Record) -> FreeDrive:
    """Compute the errors of a linear model on a drive."""
    pose = np.asarray(drive.pose)
    path = predict_path(discretise(system, drive.dt), drive.command, pose[0])
    return FreeDrive(_velocity_fit(system, [drive]), pose_error(path, pose))


def _velocity_fit(system: LinearSystem, records: Sequence[Record]) -> VelocityFit:
    validation = validate(system, records)
    return VelocityFit(_pair(validation.fit_percent), _pair(validation.rmse))


def _pair(values: Sequence[float] | np.ndarray) -> Pair:
    v, omega = (float(value) for value in values)
    return v, omega


def published_system(model: VelocityModel) -> LinearSystem:
    """Convert a published model to a system with zero sensor offsets and infinite limits, to compare it with logs."""
    return LinearSystem(model.A, model.B, model.C, model.dead_time, np.zeros(2), np.full((2, 4), np.inf))


def ssm_findings(results: Sequence[SsmResult], published: Published) -> list[PaperFinding]:
    """Evaluate P1's findings on the order and on free drives; skip findings on orders that were not identified."""
    fits = {
        order: np.array([result.orders[order - 1].test.fit_percent for result in results])
        for order in range(PAPERS_ORDER, len(results[0].orders) + 1)
    }
    printed = {order: np.array(row.values[:2]) for order, row in published.orders.items()}
    findings, rules = list[PaperFinding](), published.rules
    if set(printed) <= set(fits):
        findings.append(_improvement(fits, printed, rules.worthwhile_fit_percent))
        findings.append(_best_fit(fits, printed, rules.significant_fit_percent))
    if _MAX_ORDER in fits:
        findings.append(_overfit(fits, printed, rules.significant_fit_percent))
    return [
        *findings,
        _choice_finding(results),
        _free_drive_finding("on free drives", [result.free_drives[IDENTIFIED] for result in results], published),
        _free_drive_finding(f"on {_FAST}", [result.full_range[IDENTIFIED] for result in results], published),
    ]


def _improvement(fits: dict[int, FloatArray], printed: dict[int, FloatArray], threshold: float) -> PaperFinding:
    gains = np.array([fits[order] - fits[PAPERS_ORDER] for order in _SLIGHTLY_HIGHER])
    published = np.array([printed[order] - printed[PAPERS_ORDER] for order in _SLIGHTLY_HIGHER])
    maximum = gains.mean(axis=1).max(axis=0)
    return PaperFinding(
        f"orders 3 and 4 improve test FIT by less than {threshold:g} points over order 2, in v and in omega",
        _TABLE,
        "at most {:+.2f} and {:+.2f}".format(*published.max(axis=0)),
        "at most {:+.3f} and {:+.3f}".format(*maximum),
        as_flags((gains < threshold).all(axis=(0, 2))),
    )


def _best_fit(fits: dict[int, FloatArray], printed: dict[int, FloatArray], margin: float) -> PaperFinding:
    orders = list(fits)
    ours = np.array([fits[order].mean(axis=1) for order in orders])
    paper = np.array([printed[order].mean() for order in orders])
    best = orders[int(paper.argmax())]
    spread = float(np.ptp(ours.mean(axis=1)))
    return PaperFinding(
        f"order {best} has the best test FIT by {margin:g} points or more (mean of v and omega, orders 2 to 5)",
        _TABLE,
        f"order {best}; orders differ by {np.ptp(paper):.3f} points",
        f"order {', '.join(str(orders[i]) for i in ours.argmax(axis=0))} by repetition; "
        f"orders differ by {spread:.3f} points",
        as_flags(ours[orders.index(best)] >= np.delete(ours, orders.index(best), axis=0).max(axis=0) + margin),
    )


def _overfit(fits: dict[int, FloatArray], printed: dict[int, FloatArray], margin: float) -> PaperFinding:
    difference = fits[_MAX_ORDER][:, 1] - fits[PAPERS_ORDER][:, 1]
    return PaperFinding(
        f"order 5 explains omega worse than order 2 by {margin:g} points or more (test FIT)",
        _TABLE,
        f"{printed[_MAX_ORDER][1] - printed[PAPERS_ORDER][1]:+.2f} points",
        f"{difference.mean():+.3f} points",
        as_flags(difference <= -margin),
    )


def _choice_finding(results: Sequence[SsmResult]) -> PaperFinding:
    return PaperFinding(
        f"order {PAPERS_ORDER} is chosen (here: the lowest order within a quarter point of the best mean test FIT)",
        "P1, text on Table 1",
        f"order {PAPERS_ORDER}",
        f"order {', '.join(str(result.chosen) for result in results)} by repetition",
        tuple(result.chosen == PAPERS_ORDER for result in results),
    )


def _free_drive_finding(drive_kind: str, results: Sequence[Sequence[FreeDrive]], published: Published) -> PaperFinding:
    # The axes of `fit` are repetitions, drives and the channels v and omega.
    fit = np.array([[drive.velocity.fit_percent for drive in drives] for drives in results])
    threshold = published.rules.good_fit_percent
    holds = (fit > threshold).all(axis=(1, 2)) & (fit[:, :, 0] > fit[:, :, 1]).all(axis=1)
    return PaperFinding(
        f"{drive_kind}, the FIT of order 2 exceeds {threshold:g} % in v and omega, and v is better than omega",
        "P1, Table 3",
        "{:.2f} and {:.2f} %".format(*published.free_drives_average.values[:2]),
        "{:.2f} and {:.2f} %".format(*fit.mean(axis=(0, 1))),
        as_flags(holds),
    )


def _order_table(results: Sequence[SsmResult], published: Published) -> Table:
    """Tabulate FIT and RMSE on validation drives by order."""
    rows = []
    for k, first in enumerate(results[0].orders):
        printed = published.orders.get(first.order)
        paper = _cells(np.array(printed.values)) if printed else ["-"] * 4
        test = _cells(np.mean([result.orders[k].test.values for result in results], axis=0), 4)
        train = np.mean([result.orders[k].train.fit_percent for result in results], axis=0)
        bic = float(np.mean([result.orders[k].bic for result in results]))
        rows.append((str(first.order), *paper, *test, *_cells(train), number(bic, 0)))
    test_columns = (*(f"published {name}" for name in FIT_COLUMNS), *FIT_COLUMNS)
    train_columns = ("FIT v, train [%]", "FIT omega, train [%]", "Schwarz criterion [-]")
    note = (
        "Published: P1, Table 1, test. Ours: pooled validation drives, mean over repetitions. Order 1 is a lower "
        "bound. Schwarz criterion: training drive, minus the minimum of all orders."
    )
    return Table("SSM by order", ("order", *test_columns, *train_columns), tuple(rows), note=note)


def ssm_tables(results: Sequence[SsmResult], published: Published) -> list[Table]:
    """Tabulate orders, and velocity and odometry errors on free drives with the default and the paper's speed range."""
    return [
        _order_table(results, published),
        *_drive_tables("free drives", [result.free_drives for result in results], published),
        *_drive_tables(_FAST, [result.full_range for result in results], published),
    ]


def _drive_tables(
    drive_kind: str, results: Sequence[Mapping[str, tuple[FreeDrive, ...]]], published: Published
) -> list[Table]:
    *paper, average = (
        np.array([*drive.values, *drive.odometry.position, *drive.odometry.heading])
        for drive in (*published.free_drives, published.free_drives_average)
    )
    lines = [(_PUBLISHED, f"experiment {k}", row) for k, row in enumerate(paper, start=1)]
    lines.append((_PUBLISHED, "average", average))
    for name in results[0]:
        drives = np.array([drive.values for result in results for drive in result[name]])
        lines += [(name, f"experiment {k}", row) for k, row in enumerate(drives[: len(paper)], start=1)]
        lines.append((name, f"average of {len(drives)}", drives.mean(axis=0)))
        if len(drives) > 1:
            lines.append((name, "minimum to maximum", np.array([drives.min(axis=0), drives.max(axis=0)])))
    note = f"SSM of order 2. '{PRINTED}': the paper's matrices, to which the firmware of the plant was calibrated."
    if drive_kind == _FAST:
        note += " Set-points up to 1.5 m/s and 2.0 rad/s, as in P1, in these drives and in the training drive."
    names, errors = (
        ("model", "drive"),
        [f"{name} [{unit}], {statistic}" for name, unit in QUANTITIES.items() for statistic in STATISTICS],
    )
    fits = [(name, drive, *_ranges(row[..., :4], _DIGITS[name == _PUBLISHED])) for name, drive, row in lines]
    paths = [(name, drive, *_ranges(row[..., 4:], (2,) * len(errors))) for name, drive, row in lines]
    velocity = f"Published: P1, Table 3. {note}"
    odometry = f"Published: P1, Table 4. Prediction from commands alone, relative to the true pose. {note}"
    return [
        Table(f"SSM velocity on {drive_kind}", (*names, *FIT_COLUMNS), tuple(fits), len(names), velocity),
        Table(f"SSM odometry on {drive_kind}", (*names, *errors), tuple(paths), len(names), odometry),
    ]


def _cells(values: FloatArray, rmse_digits: int = 2) -> list[str]:
    return [number(float(value), 2 if k < 2 else rmse_digits) for k, value in enumerate(values)]


def _ranges(values: FloatArray, digits: tuple[int, ...]) -> list[str]:
    """Format the cells of values (k,), or of minima and maxima (2, k)."""
    rows = np.atleast_2d(values)
    return [" to ".join(number(float(row[k]), d) for row in rows) for k, d in enumerate(digits)]
