"""Artificial results of a reproduction."""

from pathlib import Path

import numpy as np
from bench_parts import META

from diffdrive_mpc.bench.study import Report, write_report
from studies.reproduce import networks
from studies.reproduce.cost import Cost
from studies.reproduce.drives import PathError, Spread
from studies.reproduce.mbm_and_sm import COMPARED, DATA, MBM, MBM_TRACKS, SM, MbmSmResult
from studies.reproduce.networks import NetworkResult, NetworkRow, NetworkRows
from studies.reproduce.published import load_published, load_study
from studies.reproduce.state_space import IDENTIFIED, PRINTED, FreeDrive, OrderResult, SsmResult, VelocityFit
from studies.reproduce.study import ReproduceResults, ReproduceStudy
from studies.reproduce.virtual_track import check_virtual_track

NAMES = ("circle", "square", "s", "cane")


def path_error(size: float) -> PathError:
    return PathError(Spread.of_errors([0.5 * size, size]), Spread.of_errors([0.5 * size, size]))


def mbm_sm(repetition: int = 1, *, mbm: float = 0.1, tracks: float = 0.2, sm: float = 0.3, **changes) -> MbmSmResult:
    """Return a result whose errors grow from the last trajectory to the first, as in the paper."""
    sizes = {MBM: mbm, MBM_TRACKS: tracks, SM: sm}
    path = np.column_stack([np.linspace(0.0, 1.0, 5)] * 3)
    values = {
        "motor_fit": dict.fromkeys(DATA, (95.0, 94.0, 93.0, 92.0)),
        "sm_fit": dict.fromkeys(DATA, (97.0, 88.0)),
        "errors": {
            model: {name: path_error(size / (k + 1)) for k, name in enumerate(NAMES)} for model, size in sizes.items()
        },
        "paths": {name: dict.fromkeys(("driven", *COMPARED), path) for name in NAMES},
        "responses": {"front left": path[:, :2], "v": path[:, :2]},
        "parameters": {"MBM": {"dead_time": 0.05}},
        "warnings": {"MBM": ("doubt",)},
    }
    return MbmSmResult(repetition, **{**values, **changes})


def ssm(repetition: int = 1, *, omega: tuple[float, ...] = (0.0, 90.0, 90.1, 90.4, 80.0), chosen: int = 2) -> SsmResult:
    """Return a result with these test FITs of omega by order; v is the same for all orders."""
    orders = tuple(
        OrderResult(
            order,
            train=VelocityFit((98.0, fit), (0.01, 0.05)),
            test=VelocityFit((97.0, fit), (0.01, 0.05)),
            bic=float(order),
            warnings=(),
        )
        for order, fit in enumerate(omega, start=1)
    )
    drives = (FreeDrive(VelocityFit((95.0, 92.0), (0.01, 0.05)), path_error(0.5)),) * 2
    return SsmResult(repetition, orders, chosen, "the lowest", *[{IDENTIFIED: drives, PRINTED: drives}] * 2)


def lstm(repetition: int = 1, *, ssm: float = 95.0, lstm: float = 93.0) -> NetworkResult:
    """Return a result with this FIT [%] per model; odometry errors grow as FIT falls."""
    drives = {
        name: (FreeDrive(VelocityFit((fit, fit - 2.0), (0.01, 0.05)), path_error(0.1 * (100.0 - fit))),)
        for name, fit in ((networks.SSM, ssm), (networks.LSTM, lstm), (networks.LONGER, lstm))
    }
    motion = np.column_stack([np.linspace(0.0, 1.0, 5)] * 5)
    motions = [dict.fromkeys((networks.MEASURED, *drives), motion)] * 2
    return NetworkResult(repetition, drives, motions)


def network_rows(best: int = 2) -> NetworkRows:
    """Return all rows of Table 2 of P1; row `best` has the highest FIT."""
    fits = {row: 95.0 if row == best else 94.0 for row in load_published().networks}
    return NetworkRows(
        tuple(
            NetworkRow(row, 5018, 400, *[VelocityFit((fit, fit), (0.01, 0.05))] * 2, losses=np.array([0.1, 0.01, 0.02]))
            for row, fit in fits.items()
        )
    )


def cost(mbm: float = 4e-6, sm: float = 3e-6, ssm: float = 2e-7) -> dict[str, Cost]:
    times = {"mbm": (8, mbm), "sm": (4, sm), "ssm": (2, ssm)}
    return {
        name: Cost(order, (500 * time, 1e-5), (time, 1e-7), (0.01 * order, 0.0))
        for name, (order, time) in times.items()
    }


def artificial_results(repetitions: int = 2) -> ReproduceResults:
    return ReproduceResults(
        mbm_sm=tuple(mbm_sm(k) for k in range(1, repetitions + 1)),
        ssm=tuple(ssm(k) for k in range(1, repetitions + 1)),
        lstm=tuple(lstm(k) for k in range(1, repetitions + 1)),
        rows=(network_rows(),),
        cost=cost(),
        virtual_track=check_virtual_track(load_published().virtual_track, threshold=2.0),
    )


def report_of(results: ReproduceResults) -> Report:
    return ReproduceStudy(load_study(quick=True)).report(results, 1.0)


def write_artificial_report(results: ReproduceResults, folder: Path) -> None:
    report = report_of(results)
    write_report(ReproduceStudy(load_study(quick=True)), report, META | report.meta, folder)
