"""SSM of several orders from one long free drive (Guffanti, Pavon, Sensors 2025, 25(18), 5821)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.bench.reproduce.experiments.odometry import PoseError, pose_error, predict_path, sampled
from diffdrive_mpc.bench.reproduce.experiments.robot_logs import RobotLogs
from diffdrive_mpc.bench.reproduce.study import SsmStudy
from diffdrive_mpc.models.load import load_model
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.linear_system import LinearSystem
from diffdrive_mpc.models.output_error.validation import validate
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.structures.orders import OrderRow
from diffdrive_mpc.models.structures.ssm import choose_order
from diffdrive_mpc.models.velocity_model import VelocityModel

PAPERS_ORDER = 2
"""The order that the paper settles on."""
IDENTIFIED, PRINTED = "identified", "as printed"
"""SSM of that order from our drive, and the paper's own matrices."""

Pair = tuple[float, float]
"""Of v and omega."""


@dataclass(frozen=True)
class VelocityFit:
    """FIT [%] and RMSE [m/s, rad/s] of a free simulation."""

    fit_percent: Pair
    rmse: Pair


@dataclass(frozen=True)
class OrderResult:
    """One order; the information criterion is Schwarz's, over the lowest of all orders."""

    order: int
    train: VelocityFit
    test: VelocityFit
    bic: float
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class FreeDrive:
    """One held-out drive."""

    velocity: VelocityFit
    odometry: PoseError


@dataclass(frozen=True)
class SsmResult:
    """One repetition: all orders, the one our own rule chooses and why, and the free drives by model."""

    repetition: int
    orders: tuple[OrderResult, ...]
    chosen: int
    reason: str
    free_drives: Mapping[str, tuple[FreeDrive, ...]]


def compare_orders(study: SsmStudy, repetition: int) -> SsmResult:
    """Identify every order from one free drive, and predict others."""
    logs = RobotLogs(repetition)
    train = logs.free(1, study.train_duration)
    test = logs.free(study.test_drives, study.free_duration)
    choice = choose_order(train, test, largest=study.largest_order, limits=False)
    drives = logs.free(study.free_drives, study.free_duration)
    identified = choice.rows[PAPERS_ORDER - 1].identified
    systems = {IDENTIFIED: identified.system, PRINTED: _as_printed(load_model("ssm"))}
    return SsmResult(
        repetition,
        tuple(_order(number, row, train, test) for number, row in enumerate(choice.rows, start=1)),
        choice.order,
        choice.reason,
        {name: tuple(_free_drive(system, drive) for drive in drives) for name, system in systems.items()},
    )


def _order(number: int, row: OrderRow, train: Sequence[Record], test: Sequence[Record]) -> OrderResult:
    found: IdentifiedModel = row.identified
    return OrderResult(number, _velocity(found.system, train), _velocity(found.system, test), row.bic, found.warnings)


def _free_drive(system: LinearSystem, drive: Record) -> FreeDrive:
    pose = np.asarray(drive.pose)
    path = predict_path(sampled(system, drive.dt), drive.command, pose[0])
    return FreeDrive(_velocity(system, [drive]), pose_error(path, pose))


def _velocity(system: LinearSystem, records: Sequence[Record]) -> VelocityFit:
    found = validate(system, records)
    return VelocityFit(_pair(found.fit_percent), _pair(found.rmse))


def _pair(values: Sequence[float] | np.ndarray) -> Pair:
    v, omega = (float(value) for value in values)
    return v, omega


def _as_printed(model: VelocityModel) -> LinearSystem:
    """A published model held against logs as it stands: no sensor offset, no limit."""
    return LinearSystem(model.A, model.B, model.C, model.dead_time, np.zeros(2), np.full(2, np.inf))
