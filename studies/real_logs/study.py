"""Run the proof on one log for the command line."""

from __future__ import annotations

from pathlib import Path

from diffdrive_mpc.bench.atomic import staged
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.models.identification.from_logs import FILES
from studies.real_logs.closed_loop import (
    TRAJECTORIES,
    drive,
    tracking_table,
    write_robot_files,
)
from studies.real_logs.protocol import Proof, load_protocol, prove
from studies.real_logs.tables import effect_table, parameter_table, score_table

REPORT = "proof.md"


def prove_log(name: str, data: Path, out: Path, seeds: int) -> Proof:
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
