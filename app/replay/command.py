"""What `diffdrive-mpc replay` does: the study, what it found in words, and replay.csv."""

from __future__ import annotations

import tempfile
from pathlib import Path

from diffdrive_mpc.app.replay.replay_csv import NAME, write_replay
from diffdrive_mpc.app.replay.study import Asked, ReplayStudy, agreement
from diffdrive_mpc.bench.progress import output_console
from diffdrive_mpc.bench.study import carry_out
from diffdrive_mpc.models.whole_file import check_not_read


def replay_into(asked: Asked, out: Path) -> None:
    """Replay a log into the folder `out`, and say what was found; raises as `carry_out` does."""
    check_not_read(out / NAME, f"--out {out / NAME}")
    with tempfile.TemporaryDirectory() as folder:
        found = carry_out(ReplayStudy(asked, Path(folder)), out)
        recording = found.plan.recording
        write_replay(recording, found.replayed, found.other, out / NAME)
    console = output_console()
    lines = [agreement(found, by_controller=recording.by_controller), found.plan.reference_words]
    lines += [*recording.approximated, *recording.findings]
    for line in lines:
        console.print(line, markup=False, highlight=False)
