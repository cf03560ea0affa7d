"""Run the proof on one log for the command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.report_folder import staged
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.identification.from_logs import FILES
from studies.real_logs.closed_loop import (
    TRAJECTORIES,
    drive,
    tracking_table,
    write_robot_files,
)
from studies.real_logs.protocol import LogProof, load_protocol, prove

# Tables of the proof on logs of real robots.


def score_table(proof: LogProof) -> Table:
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


def effect_table(proof: LogProof) -> Table:
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


def parameter_table(proof: LogProof) -> Table:
    """What was found, with standard deviations."""
    estimates = [proof.base.identified.parameters, *([proof.base.pose] if proof.base.pose else [])]
    return Table(
        title="Parameters",
        columns=("parameter", "value", "standard deviation"),
        rows=tuple(
            (name, f"{value:.4g}", f"{deviation:.2g}")
            for estimate in estimates
            for name, value, deviation in estimate.rows
        ),
        note="SI units.",
    )


REPORT = "proof.md"


def prove_log(name: str, data: Path, out: Path, seeds: int) -> LogProof:
    """Identify, score, drive; print the tables and write them, with the robot's files, into `out`.

    Parameters
    ----------
    name
        Of the log, as in `protocol.yaml`.
    data
        The folder of the logs.
    out
        Where the files go.
    seeds
        Closed-loop runs of each kind.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError, OSError
        If there is no such log, it cannot be used, or `out` cannot be written to; then `out` keeps what it held.
    """
    log = load_protocol().log(name)
    with staged(out, files=(*FILES, REPORT), owner="real-logs") as folder, ProgressBar("identifying") as bar:
        proof = prove(log, data, lambda text: bar.begin(text, 1))
        write_robot_files(proof, folder)
        tables = [score_table(proof), effect_table(proof), parameter_table(proof)]
        if seeds:
            bar.begin("driving", 2 * len(TRAJECTORIES) * seeds)
            tables.append(tracking_table(drive(folder, range(seeds), bar.advance)))
        text = "\n\n".join(table.markdown() for table in tables)
        (folder / REPORT).write_text(f"# {log.robot}\n\n{text}\n", encoding="utf-8")
    console = output_console()
    for table in tables:
        console.print(table.rich())
    for warning in proof.base.identified.warnings:
        console.print(f"warning: {warning}", markup=False, highlight=False, soft_wrap=True)
    return proof
