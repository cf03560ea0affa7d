"""SSM by order, and on free drives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.bench.reproduce.experiments.odometry import PoseError
from diffdrive_mpc.bench.reproduce.experiments.state_space import IDENTIFIED, PRINTED, FreeDrive, SsmResult, VelocityFit
from diffdrive_mpc.bench.reproduce.published import Published, PublishedDrive
from diffdrive_mpc.bench.reproduce.tables.mbm_and_sm import STATISTICS
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.interface import FloatArray

_FIT_COLUMNS = ("FIT v [%]", "FIT omega [%]", "RMSE v [m/s]", "RMSE omega [rad/s]")
_PUBLISHED = "published"
_DIGITS = {True: (2, 2, 2, 2), False: (2, 2, 4, 4)}
"""Of FIT and RMSE: the paper's, ours."""


def order_table(results: Sequence[SsmResult], published: Published) -> Table:
    """FIT and RMSE by order, on drives held out."""
    rows = []
    for k, first in enumerate(results[0].orders):
        printed = published.orders.get(first.order)
        paper = _cells(np.array([*_both(printed.fit_percent), *_both(printed.rmse)])) if printed else ["-"] * 4
        test = _cells(np.mean([_velocity(result.orders[k].test) for result in results], axis=0), 4)
        train = np.mean([result.orders[k].train.fit_percent for result in results], axis=0)
        bic = float(np.mean([result.orders[k].bic for result in results]))
        rows.append((str(first.order), *paper, *test, *_cells(train), number(bic, 0)))
    columns = (
        "order",
        *(f"published {name}" for name in _FIT_COLUMNS),
        *_FIT_COLUMNS,
        "FIT v, train [%]",
        "FIT omega, train [%]",
        "Schwarz criterion [-]",
    )
    note = (
        "Published: P1, Table 1, test. Ours: drives held out, pooled; mean over repetitions. Order 1 is a floor: one "
        "state cannot follow both channels. Schwarz's criterion (train) over the lowest of all orders."
    )
    return Table("SSM by order", columns, tuple(rows), note=note)


def free_drive_tables(results: Sequence[SsmResult], published: Published) -> list[Table]:
    """Velocity and odometry on free drives: the paper's experiments beside ours."""
    paper = [_of_paper(drive) for drive in published.free_drives]
    ours = {
        name: np.array([[_of_drive(one) for one in r.free_drives[name]] for r in results]) for name in _names(results)
    }
    lines = [(_PUBLISHED, f"experiment {k}", row) for k, row in enumerate(paper, start=1)]
    lines.append((_PUBLISHED, "average", np.mean(paper, axis=0)))
    for name, table in ours.items():
        drives = table.reshape(-1, table.shape[-1])
        lines += [(name, f"experiment {k}", row) for k, row in enumerate(drives[: len(paper)], start=1)]
        lines.append((name, f"average of {len(drives)}", drives.mean(axis=0)))
        if len(drives) > 1:
            lines.append((name, "least to largest", np.array([drives.min(axis=0), drives.max(axis=0)])))
    note = f"SSM of order 2. '{PRINTED}': the paper's matrices; our plant's firmware was calibrated to them."
    return [
        Table(
            "SSM velocity on free drives",
            ("model", "drive", *_FIT_COLUMNS),
            tuple((name, drive, *_ranges(row[..., :4], _DIGITS[name == _PUBLISHED])) for name, drive, row in lines),
            text_columns=2,
            note=f"Published: P1, Table 3. {note}",
        ),
        Table(
            "SSM odometry on free drives",
            (
                "model",
                "drive",
                *(f"{what}, {statistic}" for what in ("position [m]", "heading [rad]") for statistic in STATISTICS),
            ),
            tuple((name, drive, *_ranges(row[..., 4:], (2,) * 8)) for name, drive, row in lines),
            text_columns=2,
            note=f"Published: P1, Table 4. From commands alone, against the true pose. {note}",
        ),
    ]


def _names(results: Sequence[SsmResult]) -> list[str]:
    return [name for name in (IDENTIFIED, PRINTED) if name in results[0].free_drives]


def _both(fit: object) -> tuple[float, float]:
    return fit.v, fit.omega  # type: ignore[attr-defined]


def _velocity(fit: VelocityFit) -> FloatArray:
    return np.array([*fit.fit_percent, *fit.rmse])


def _of_drive(drive: FreeDrive) -> FloatArray:
    """(12,) FIT and RMSE of v and omega, then the statistics of position and heading."""
    error: PoseError = drive.odometry
    statistics = [getattr(spread, field) for spread in (error.position, error.heading) for field in STATISTICS.values()]
    return np.concatenate([_velocity(drive.velocity), statistics])


def _of_paper(drive: PublishedDrive) -> FloatArray:
    return np.array([*_both(drive.fit_percent), *_both(drive.rmse), *drive.odometry.position, *drive.odometry.heading])


def _cells(values: FloatArray, rmse_digits: int = 2) -> list[str]:
    return [number(float(value), 2 if k < 2 else rmse_digits) for k, value in enumerate(values)]


def _ranges(values: FloatArray, digits: tuple[int, ...]) -> list[str]:
    """Cells of one row (k,), or of two (2, k) with "to" between them."""
    rows = np.atleast_2d(values)
    return [" to ".join(number(float(row[k]), d) for row in rows) for k, d in enumerate(digits)]
