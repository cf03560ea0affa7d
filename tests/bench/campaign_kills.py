"""Kill parts of a campaign at random moments (SIGKILL), start them again, and hold the results against quiet ones.

python tests/bench/campaign_kills.py --kills 20
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
from dask_cluster import free_port

from diffdrive_mpc.bench.campaign.parquet import read_table

RUNS = 16
PATH = "name: short\nsegments:\n- {v: 0.3, omega: 0.4, duration: 1.5}\n"
CAMPAIGN = f"""
description: short drives of a model
runs: {RUNS}
factors:
  trajectory: short.yaml
  plant: "model:sm"
  model: {{one_of: [ssm, sm]}}
  config.weights.across: {{log_uniform: [300, 1500]}}  # 1/m^2
  sensors.pose.latency: {{uniform: [0.0, 0.1]}}        # s
"""
COMMAND = (sys.executable, "-c", "from diffdrive_mpc.app.cli import main; main()")
LONGEST = 600.0
LOST_SCHEDULER = 1


class Disturbed:
    """A campaign under way, with what it needs; `kill` ends one part, `tend` starts again what is gone."""

    def __init__(self, folder: Path, out: Path, *, dask: bool) -> None:
        self._log = (folder / "processes.log").open("ab")
        port = free_port()
        address = f"tcp://127.0.0.1:{port}"
        place = ("--scheduler", address) if dask else ("--jobs", "2")
        self._out, self._dask = out, dask
        dasks = (sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny")
        self._commands: dict[str, tuple[str, ...]] = {
            "campaign": (*COMMAND, "campaign", str(folder / "campaign.yaml"), "--out", str(out), *place)
        }
        if dask:
            scheduler = (sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1")
            rest = ("--no-dashboard", "--local-directory", str(folder))
            self._commands = {
                "scheduler": (*scheduler, "--port", str(port), "--no-dashboard"),
                "worker 1": (*dasks, *rest),
                "worker 2": (*dasks, *rest),
            } | self._commands
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self.killed: list[str] = []

    def tend(self) -> bool:
        """Start what does not run; returns whether the campaign has come to its end. Raises if it gave up."""
        for name, command in self._commands.items():
            process = self._processes.get(name)
            if process is not None and process.poll() is None:
                continue
            if name == "campaign" and process is not None and process.returncode != -signal.SIGKILL:
                if process.returncode == 0:
                    return True
                # A campaign without its scheduler ends with this code; started again, it drives the missing runs.
                if not (self._dask and process.returncode == LOST_SCHEDULER):
                    raise RuntimeError(f"the campaign ended with {process.returncode}; see {self._log.name}")
            if name == "campaign" and self._dask and process is None:
                time.sleep(2.0)  # the scheduler needs a moment for its port
            self._processes[name] = subprocess.Popen(command, stdout=self._log, stderr=self._log)
        return False

    def kill(self, chance: random.Random) -> None:
        """Kill one part; of a campaign on this machine, a process of its pool or itself."""
        name = chance.choice([*self._commands])
        process = self._processes[name]
        pool = [] if self._dask else self._pool(process.pid)
        if pool and chance.random() < 0.5:
            chance.choice(pool).kill()
            name = "pool"
        else:
            process.kill()
            process.wait()
        self.killed.append(name)

    @staticmethod
    def _pool(pid: int) -> list[psutil.Process]:
        return [child for child in psutil.Process(pid).children() if "popen_loky" in " ".join(child.cmdline())]

    def done(self) -> int:
        """How many runs are kept."""
        return sum(1 for _ in self._out.glob("runs/*/*.json"))

    def end(self) -> None:
        """End all that was started."""
        for process in self._processes.values():
            if process.poll() is None:
                process.kill()
            process.wait()
        self._log.close()


def prepare(folder: Path) -> Path:
    """Write the campaign, drive it undisturbed, and give the folder of its results."""
    (folder / "campaign.yaml").write_text(CAMPAIGN, encoding="utf-8")
    (folder / "short.yaml").write_text(PATH, encoding="utf-8")
    quiet = folder / "undisturbed"
    words = ("campaign", str(folder / "campaign.yaml"), "--out", str(quiet), "--jobs", "1")
    subprocess.run([*COMMAND, *words], check=True, stdout=subprocess.DEVNULL)
    return quiet


def disturb(folder: Path, quiet: Path, kills: int, chance: random.Random, *, dask: bool) -> list[str]:
    """Drive the campaign, kill something up to `kills` times, compare; returns what was killed."""
    out = Path(tempfile.mkdtemp(prefix="disturbed-", dir=folder))
    under_way = Disturbed(folder, out, dask=dask)
    began, since, moment = time.monotonic(), 0, 0.0
    try:
        while not under_way.tend():
            assert time.monotonic() - began < LONGEST, "the campaign does not come to its end"
            # Something was done since the last kill: it is in the middle of its work.
            if len(under_way.killed) < kills and under_way.done() > since:
                moment = moment or time.monotonic() + chance.uniform(0.0, 0.5)
                if time.monotonic() >= moment:
                    under_way.kill(chance)
                    since, moment = under_way.done(), 0.0
            time.sleep(0.02)
    finally:
        under_way.end()
    compare(quiet, out)
    return under_way.killed


def compare(quiet: Path, disturbed: Path) -> None:
    """Raise if a run was lost or counted twice, or differs in one bit of any column but those of time."""
    expected, found = (read_table(out / "results.parquet", times=False) for out in (quiet, disturbed))
    assert found.num_rows == RUNS
    assert len(set(found.column("run").to_pylist())) == RUNS
    assert found.equals(expected)
    kept = [sorted(path.name for path in out.glob("runs/*/*.json")) for out in (quiet, disturbed)]
    assert kept[0] == kept[1]


def main() -> None:
    """Kill so often as asked, in as many campaigns as that takes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=int.from_bytes(os.urandom(2)))
    asked = parser.parse_args()
    chance = random.Random(asked.seed)
    killed: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        quiet = prepare(Path(name))
        while len(killed) < asked.kills:
            left = asked.kills - len(killed)
            dask = chance.random() < 0.75
            killed += disturb(Path(name), quiet, min(left, 5), chance, dask=dask)
            print(f"seed {asked.seed}: {len(killed)} kills so far, last {killed[-5:]}; results equal", flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
