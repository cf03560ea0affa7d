"""Linear fits beside the thirty-line baseline with a limit of the command (`oracle/second_order.py`), on the same rows.

`python tests/models/behind_baseline.py` prints FIT on rows held out, of three real logs and three simulated ones, and
ends with 1 where a fit is more than a point behind, as MBM's is: its channels share their motors. Logs lie where
DIFFDRIVE_MPC_DATA says.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from baseline_parts import CUTS, baseline_fit, cut_records
from real_log_files import FOLDERS, log_path

from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.logs.geometry import wheel_geometry
from diffdrive_mpc.models.output_error.validation import validate
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.models.structures.structure import IdentificationConditions

PLANTS = ("mujoco", "mujoco:short_of_speed", "model:mbm")
ALLOWED = 1.0


def real_logs():
    """Records by name of the log."""
    return {name: read_log(log_path(name), name).records for name in FOLDERS}


def simulated_logs():
    """Records by name of the plant, of a drive of 90 s that excites both channels."""
    logs = {}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        _run("excite", "--out", folder / "drive.yaml")
        for seed, plant in enumerate(PLANTS):
            path = folder / f"{seed}.csv"
            options = ("--trajectory", folder / "drive.yaml", "--plant", plant, "--seed", str(seed), "--log", path)
            _run("simulate", *options)
            logs[plant] = read_log(path).records
    return logs


def _run(*words):
    result = CliRunner().invoke(app, list(map(str, words)))
    assert result.exit_code == 0, result.output


def compare(name, records, structures):
    """The largest number of points by which a structure is behind on any cut; prints a line for each."""
    worst = -np.inf
    for place, share in CUTS:
        train, held_out = cut_records(records, place, share)
        geometry = wheel_geometry(train)
        conditions = IdentificationConditions(held_out, "gyro", None, geometry.radius if geometry else None)
        plain = baseline_fit(train, held_out)
        baseline = np.maximum(plain, baseline_fit(train, held_out, clip=True))
        for structure in structures:
            identified = STRUCTURES[structure].identify(train, conditions).identified
            fit = validate(identified.system, held_out).fit_percent
            behind = baseline - fit
            worst = max(worst, behind.max())
            limits = ", ".join(f"{channel} {level:.3g}" for channel, level in identified.limits.items()) or "none"
            sys.stdout.write(
                f"{name:22} {place:>5} {share:.1f} {structure:>4}   {baseline[0]:6.2f} {baseline[1]:6.2f}   "
                f"{fit[0]:6.2f} {fit[1]:6.2f}   {behind[0]:6.2f} {behind[1]:6.2f}   {limits}\n"
            )
            sys.stdout.flush()
    return worst


def main():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--structures", nargs="+", default=["sm", "mbm", "ssm"])
    structures = parser.parse_args().structures
    sys.stdout.write("log, train, structure; FIT [%] of v and omega: baseline, fit, behind; limits found\n")
    worst = max(compare(name, records, structures) for name, records in (real_logs() | simulated_logs()).items())
    sys.stdout.write(f"at most {worst:.2f} points behind the baseline\n")
    sys.exit(worst > ALLOWED)


if __name__ == "__main__":
    main()
