"""Rules on MBM and SM (Guffanti et al., Sensors 2025, 25(11), 3553)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.bench.reproduce.experiments.mbm_and_sm import DATA, MBM, MBM_TRACKS, SM, MbmSmResult
from diffdrive_mpc.bench.reproduce.findings.finding import Finding, each
from diffdrive_mpc.bench.reproduce.published import Published
from diffdrive_mpc.models.interface import FloatArray

_HELD_OUT = DATA[1]
_QUANTITIES = {"position": "m", "heading": "rad"}
_CIRCLE = "circle"


def mbm_sm_findings(results: Sequence[MbmSmResult], published: Published) -> list[Finding]:
    """FIT of motors and channels, and who predicts paths better."""
    least, fit = published.motor_fit_percent, published.sm_fit_percent
    motors = np.array([result.motor_fit[_HELD_OUT] for result in results])
    channels = np.array([result.sm_fit[_HELD_OUT] for result in results])
    v, omega = channels.mean(axis=0)
    return [
        Finding(
            f"two poles without zeros explain every motor with a FIT above {least:g} % (steps held out)",
            "P0, section on MBM",
            f"all four > {least:g} %",
            f"{motors.mean(axis=0).min():.1f} to {motors.mean(axis=0).max():.1f} %",
            each((motors > least).all(axis=1)),
        ),
        Finding(
            "SM explains v better than omega (steps held out)",
            "P0, section on SM",
            f"{fit.v:.2f} against {fit.omega:.2f} %",
            f"{v:.2f} against {omega:.2f} %",
            each(channels[:, 0] > channels[:, 1]),
        ),
        *(_beats_sm(results, published, MBM, "MBM", quantity) for quantity in _QUANTITIES),
        *(
            _beats_sm(results, published, MBM_TRACKS, "MBM with identified tracks", quantity)
            for quantity in _QUANTITIES
        ),
        *([_circle_is_worst(results, published)] if _CIRCLE in results[0].errors[SM] else []),
    ]


def _beats_sm(results: Sequence[MbmSmResult], published: Published, model: str, words: str, quantity: str) -> Finding:
    ours, theirs = _rmse(results, model, quantity), _rmse(results, SM, quantity)
    printed = [_printed(published, of, list(results[0].errors[SM]), quantity) for of in ("mbm", "sm")]
    return Finding(
        f"{words} predicts the {quantity} better than SM on every trajectory (RMSE)",
        "P0, Table 2" if model == MBM else "P0, Table 2; the tracks are ours",
        _compared(printed[0], printed[1], _QUANTITIES[quantity]),
        _compared(ours.mean(axis=0), theirs.mean(axis=0), _QUANTITIES[quantity]),
        each((ours < theirs).all(axis=1)),
    )


def _circle_is_worst(results: Sequence[MbmSmResult], published: Published) -> Finding:
    names = list(results[0].errors[SM])
    circle = names.index(_CIRCLE)
    printed = {of.upper(): _printed(published, of, names, "position") for of in ("mbm", "sm")}
    ours = {of: _rmse(results, of, "position") for of in (MBM, SM)}
    worst = np.array([table.argmax(axis=1) for table in ours.values()])
    return Finding(
        "the circle has the largest position RMSE, for MBM and for SM",
        "P0, Table 2",
        ", ".join(f"{of}: {names[int(values.argmax())]}" for of, values in printed.items()),
        ", ".join(f"{of}: {names[int(table.mean(axis=0).argmax())]}" for of, table in ours.items()),
        each((worst == circle).all(axis=0)),
    )


def _rmse(results: Sequence[MbmSmResult], model: str, quantity: str) -> FloatArray:
    """(repetitions, trajectories)."""
    return np.array([[getattr(error, quantity).rmse for error in result.errors[model].values()] for result in results])


def _printed(published: Published, model: str, names: Sequence[str], quantity: str) -> FloatArray:
    """(trajectories,) printed RMSE, which is the first of the printed statistics."""
    return np.array([getattr(published.odometry[model][name], quantity)[0] for name in names])


def _compared(ours: FloatArray, theirs: FloatArray, unit: str) -> str:
    a, b = float(ours.mean()), float(theirs.mean())
    return f"{np.sum(ours < theirs)} of {len(ours)}; mean {a:.3f} against {b:.3f} {unit} ({100 * (a / b - 1):+.0f} %)"
