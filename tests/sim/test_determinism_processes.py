"""The physics under the predictive controller, bit for bit the same in every process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
SEGMENTS = """\
segments:  # v [m/s], omega [rad/s], duration [s]
  - {v: 0.5, omega: 0.5, duration: 0.8}
  - {v: 0.0, omega: -1.0, duration: 0.4}
"""
SCRIPT = """\
import hashlib, sys
import numpy as np
from diffdrive_mpc.mpc import Controller, load_config, load_trajectory
from diffdrive_mpc.sim import make_plant, simulate

reference = load_trajectory(sys.argv[1])
for seed in (3, 4):
    run = simulate(Controller(load_config(sys.argv[2])), make_plant("mujoco", seed=seed), reference)
    assert run.metrics.completed and run.true_pose[-1, 0] > 0.1, run.metrics
    for series in (run.command, run.true_pose, run.measured_pose):
        print(seed, len(run.time), hashlib.sha256(np.ascontiguousarray(series).tobytes()).hexdigest())
"""


def _digests(trajectory: Path, model: str, hash_seed: str) -> list[str]:
    """Seed, ticks, and the digests of commands, true and measured poses, of runs in a process of its own."""
    environment = {**os.environ, "PYTHONHASHSEED": hash_seed, "PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(trajectory), model],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_two_processes_command_and_drive_the_same_bit_for_bit(tmp_path: Path) -> None:
    trajectory = tmp_path / "short.yaml"
    trajectory.write_text(SEGMENTS)
    first, again = (_digests(trajectory, "ssm", hash_seed) for hash_seed in ("1", "2"))
    assert first == again
    digests = [line.split()[2] for line in first]
    assert len(set(digests)) == len(digests) == 6  # another seed is another run
