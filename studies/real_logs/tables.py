"""Tables of the proof on logs of real robots."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.bench.table import Table
from studies.real_logs.protocol import Proof, load_protocol


def score_table(proof: Proof) -> Table:
    """FIT and pose errors on the rows held out: stated, linear, with effects."""
    stated = proof.log.stated
    horizons = load_protocol().horizons if proof.base.pose else ()
    rows = [
        ("stated baseline", stated.fit_percent, stated.position, stated.heading),
        *(
            (
                score.model,
                tuple(score.fit_percent),
                tuple(drift.position_rmse for drift in score.drift),
                tuple(drift.heading_rmse for drift in score.drift),
            )
            for score in proof.scores
        ),
    ]
    columns = ["model", "FIT v [%]", "FIT omega encoders [%]", "FIT omega gyro [%]"]
    columns += [f"position {horizon:g} s [m]" for horizon in horizons]
    columns += [f"heading {horizon:g} s [rad]" for horizon in horizons]
    return Table(
        title=proof.log.robot,
        columns=tuple(columns),
        rows=tuple(
            (
                name,
                *("-" if value is None or np.isnan(value) else f"{value:.1f}" for value in fit),
                *(f"{value:.3f}" for value in (*position, *heading)),
            )
            for name, fit, position, heading in rows
        ),
        note=f"On the last {100 * (1 - load_protocol().share):.0f} % of the rows; identified from the others in "
        f"{proof.found.report.fitted.seconds:.0f} s. Pose errors are RMS.",
    )


def effect_table(proof: Proof) -> Table:
    """What was tried, and what it was worth on held-out blocks of the rows to fit."""
    return Table(
        title="Effects of the base",
        columns=("effect", "tried", "worth [-]", "better blocks", "kept"),
        rows=tuple(
            (
                trial.effect,
                "again, beside all others" if trial.again else "in turn",
                f"{trial.gain:+.3f}",
                str(trial.blocks),
                "yes" if trial.kept else "no",
            )
            for trial in proof.base.trials
        ),
        text_columns=2,
        note="Worth: fall of the logarithm of the held-out error power, mean over the sensors.",
    )


def parameter_table(proof: Proof) -> Table:
    """What was found, with standard deviations."""
    estimates = [proof.base.identified.parameters, *([proof.base.pose] if proof.base.pose else [])]
    return Table(
        title="Parameters",
        columns=("parameter", "value", "standard deviation"),
        rows=tuple(
            (name, f"{value:.4g}", f"{deviation:.2g}")
            for estimate in estimates
            for name, value, deviation in zip(estimate.names, estimate.values, estimate.standard_deviation, strict=True)
        ),
        note="SI units.",
    )
