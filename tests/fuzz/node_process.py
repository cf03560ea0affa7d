"""Node in a process: its state, log, memory and threads."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path

_CODE = "from diffdrive_mpc.app.cli import main; main()"
_ALARMING = re.compile(
    r"Traceback|\[FATAL\]|FAULT: |Segmentation|core dumped|terminate called|ticks cannot be replayed"
)


class NodeProcess:
    """`diffdrive-mpc node` with parameters; its output goes to a file."""

    def __init__(self, log: Path, parameters: dict[str, object]) -> None:
        arguments = ["node", "--ros-args", "--log-level", "info"]
        for name, value in parameters.items():
            arguments += ["-p", f"{name}:={str(value).lower() if isinstance(value, bool) else value}"]
        self.log = log
        with log.open("w") as out:
            self.process = subprocess.Popen(
                [sys.executable, "-X", "faulthandler", "-c", _CODE, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
            )

    @property
    def alive(self) -> bool:
        """True while the process runs."""
        return self.process.poll() is None

    def alarms(self) -> list[str]:
        """Return log lines that must not occur for any input."""
        lines = self.log.read_text(errors="replace").splitlines()
        numbers = [number for number, line in enumerate(lines) if _ALARMING.search(line)]
        return [
            " | ".join(lines[number : number + 1] + lines[max(number + 1, number + 12) - 1 : number + 12])[:600]
            for number in numbers
        ]

    def used(self) -> tuple[float, int]:
        """Return memory in use [MB] and number of threads; zeros if unknown."""
        try:
            text = Path(f"/proc/{self.process.pid}/status").read_text()
        except OSError:
            return 0.0, 0
        status = dict(re.findall(r"^(VmRSS|Threads):\s+(\d+)", text, re.MULTILINE))
        return int(status.get("VmRSS", 0)) / 1000, int(status.get("Threads", 0))

    def end(self, number: int = signal.SIGTERM, timeout: float = 20.0) -> int | None:
        """Send a signal and wait; return the exit code, or None if the process had to be killed."""
        if self.alive:
            self.process.send_signal(number)
        try:
            return self.process.wait(timeout)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            return None
