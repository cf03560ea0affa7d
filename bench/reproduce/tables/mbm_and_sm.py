"""FIT of motors and channels, and odometry errors of MBM and SM."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.bench.reproduce.experiments.mbm_and_sm import COMPARED, DATA, SM, MbmSmResult
from diffdrive_mpc.bench.reproduce.published import Published
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.velocity_model import CHANNELS

STATISTICS = {"RMSE": "rmse", "mean": "mean", "standard deviation": "std", "max": "max"}
"""Names of the papers' statistics, in the order of their tables."""
_MOTORS = ("front left", "front right", "rear left", "rear right")


def fit_table(results: Sequence[MbmSmResult], published: Published) -> Table:
    """FIT of the four motors and of both channels of SM."""
    motors = {name: np.mean([result.motor_fit[name] for result in results], axis=0) for name in DATA}
    channels = {name: np.mean([result.sm_fit[name] for result in results], axis=0) for name in DATA}
    printed = published.sm_fit_percent.model_dump()
    rows = [
        ("MBM", motor, f"> {published.motor_fit_percent:g}", *(number(float(motors[name][i]), 2) for name in DATA))
        for i, motor in enumerate(_MOTORS)
    ]
    rows += [
        ("SM", channel, number(printed[channel], 2), *(number(float(channels[name][i]), 2) for name in DATA))
        for i, channel in enumerate(CHANNELS)
    ]
    note = (
        "FIT [%] of a free simulation from commands, mean over repetitions. The paper does not say which part of its "
        "data its figures belong to. Steps of its own for each: wheels for the motors, v and omega for SM."
    )
    columns = ("model", "output", "published", *DATA)
    return Table("FIT of motors and of SM", columns, tuple(rows), text_columns=2, note=note)


def odometry_tables(results: Sequence[MbmSmResult], published: Published) -> list[Table]:
    """Position and heading errors by trajectory and statistic."""
    return [
        _odometry(results, published, "position", "Position errors of open-loop odometry", "error [m]"),
        _odometry(results, published, "heading", "Heading errors of open-loop odometry", "error [rad]"),
    ]


def _odometry(results: Sequence[MbmSmResult], published: Published, quantity: str, title: str, error: str) -> Table:
    names = list(results[0].errors[SM])
    ours = {model: _errors(results, model, quantity) for model in COMPARED}
    printed = {
        model: np.array([getattr(published.odometry[model][name], quantity) for name in names])
        for model in ("mbm", "sm")
    }
    rows = []
    for i, statistic in enumerate(STATISTICS):
        for k, name in enumerate((*names, "average")):
            of_paper = [_cell(printed[model], k, i) for model in printed]
            of_plant = [_cell(ours[model], k, i) for model in COMPARED]
            rows.append((statistic, name, *of_paper, *of_plant))
    columns = (error, "trajectory", "published MBM", "published SM", *COMPARED)
    note = (
        "Predicted from commands alone, against the true pose; mean over repetitions. Published: P0, Table 2, "
        "averages from its rows. The paper's twists and durations are not in its text: the paths are of one shape, "
        "not of one size."
    )
    return Table(title, columns, tuple(rows), text_columns=2, note=note)


def _errors(results: Sequence[MbmSmResult], model: str, quantity: str) -> FloatArray:
    """(trajectories, statistics), mean over repetitions."""
    every = [
        [
            [getattr(getattr(error, quantity), field) for field in STATISTICS.values()]
            for error in result.errors[model].values()
        ]
        for result in results
    ]
    return np.asarray(np.mean(every, axis=0))


def _cell(table: FloatArray, row: int, column: int) -> str:
    values = table[:, column]
    return number(float(values[row] if row < len(values) else values.mean()), 3)
