"""Rules on SSM (Guffanti, Pavon, Sensors 2025, 25(18), 5821)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.bench.reproduce.experiments.state_space import IDENTIFIED, PAPERS_ORDER, SsmResult
from diffdrive_mpc.bench.reproduce.findings.finding import Finding, each
from diffdrive_mpc.bench.reproduce.published import Published
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.structures.model_file import ChannelFit

_TABLE = "P1, Table 1"
_SLIGHTLY_HIGHER = (3, 4)
_HIGHEST = 5


def ssm_findings(results: Sequence[SsmResult], published: Published) -> list[Finding]:
    """Which order, and how good the paper's is on free drives. Rules on orders that were not run are left out."""
    fits = {
        order: np.array([result.orders[order - 1].test.fit_percent for result in results])
        for order in range(PAPERS_ORDER, len(results[0].orders) + 1)
    }
    printed = {order: _pair(row.fit_percent) for order, row in published.orders.items()}
    every = set(printed) <= set(fits)
    findings = (
        [_worthwhile(fits, printed, published.rules.worthwhile_fit_percent), _best(fits, printed)] if every else []
    )
    if _HIGHEST in fits:
        findings.append(_overfits(fits, printed))
    return [*findings, _chosen(results), _free_drives(results, published)]


def _worthwhile(fits: dict[int, FloatArray], printed: dict[int, FloatArray], least: float) -> Finding:
    gains = np.array([fits[order] - fits[PAPERS_ORDER] for order in _SLIGHTLY_HIGHER])
    published = np.array([printed[order] - printed[PAPERS_ORDER] for order in _SLIGHTLY_HIGHER])
    most = gains.mean(axis=1).max(axis=0)
    return Finding(
        f"orders 3 and 4 bring less than {least:g} points of test FIT over order 2, in v and in omega",
        _TABLE,
        "at most {:+.2f} and {:+.2f}".format(*published.max(axis=0)),
        "at most {:+.3f} and {:+.3f}".format(*most),
        each((gains < least).all(axis=(0, 2))),
    )


def _best(fits: dict[int, FloatArray], printed: dict[int, FloatArray]) -> Finding:
    orders = list(fits)
    ours = np.array([fits[order].mean(axis=1) for order in orders])
    paper = np.array([printed[order].mean() for order in orders])
    winner = orders[int(paper.argmax())]
    spread = float(np.ptp(ours.mean(axis=1)))
    return Finding(
        f"order {winner} has the best test FIT (mean of v and omega, orders 2 to 5)",
        _TABLE,
        f"order {winner}; orders differ by {np.ptp(paper):.3f} points",
        f"order {', '.join(str(orders[i]) for i in ours.argmax(axis=0))} by repetition; "
        f"orders differ by {spread:.3f} points",
        each(ours.argmax(axis=0) == orders.index(winner)),
    )


def _overfits(fits: dict[int, FloatArray], printed: dict[int, FloatArray]) -> Finding:
    fall = fits[_HIGHEST][:, 1] - fits[PAPERS_ORDER][:, 1]
    return Finding(
        "order 5 explains omega worse than order 2 (test FIT)",
        _TABLE,
        f"{printed[_HIGHEST][1] - printed[PAPERS_ORDER][1]:+.2f} points",
        f"{fall.mean():+.3f} points",
        each(fall < 0),
    )


def _chosen(results: Sequence[SsmResult]) -> Finding:
    return Finding(
        f"order {PAPERS_ORDER} is the choice (ours: the lowest order within a quarter point of the best mean test FIT)",
        "P1, text on Table 1",
        f"order {PAPERS_ORDER}",
        f"order {', '.join(str(result.chosen) for result in results)} by repetition",
        tuple(result.chosen == PAPERS_ORDER for result in results),
    )


def _free_drives(results: Sequence[SsmResult], published: Published) -> Finding:
    # (repetitions, drives, 2)
    fit = np.array([[drive.velocity.fit_percent for drive in result.free_drives[IDENTIFIED]] for result in results])
    paper = np.array([_pair(drive.fit_percent) for drive in published.free_drives])
    least = published.rules.good_fit_percent
    good = (fit > least).all(axis=(1, 2)) & (fit[:, :, 0] > fit[:, :, 1]).all(axis=1)
    return Finding(
        f"on free drives order 2 explains v and omega above {least:g} % each, and v better than omega",
        "P1, Table 3",
        "{:.2f} and {:.2f} %".format(*paper.mean(axis=0)),
        "{:.2f} and {:.2f} %".format(*fit.mean(axis=(0, 1))),
        each(good),
    )


def _pair(fit: ChannelFit) -> FloatArray:
    return np.array([fit.v, fit.omega])
