"""Hands a drive to the process that writes it, and never waits while doing so."""

from __future__ import annotations

import pickle
import select
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from diffdrive_mpc.models.logs.drive_log.process import LARGEST, OVER, READY

_BUFFER = 1 << 22
"""Bytes on their way that are asked for; the system may grant less."""
Metadata = Mapping[str, Mapping[str, str]]


class DriveRecorder:
    """Records one drive into a new file. After the constructor nothing raises: a recording is not worth a robot.

    Parameters
    ----------
    path
        The file; one of that name that is there already stays, and the new one gets a number.
    metadata
        What the file says of the drive.
    patience
        How long to wait until the file is there [s].
    **options
        As for `DriveWriter`.

    Attributes
    ----------
    path
        The file, once it is there.
    fault
        Why no more is recorded; empty while it is.
    taken, lost
        Parcels handed over, and those for which the writer was too slow.
    """

    def __init__(self, path: Path, metadata: Metadata, *, patience: float, **options: object) -> None:
        self.path, self.fault, self.taken, self.lost = path, "", 0, 0
        self._prepared: list[tuple[object, ...]] = []
        # Datagrams in order: one is taken whole or not at all, and without waiting.
        self._link, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        self._link.setblocking(False)
        command = [sys.executable, "-m", "diffdrive_mpc.models.logs.drive_log.process", str(theirs.fileno())]
        try:
            # A session of its own: Ctrl-C is for the robot, and the file is ended after its last command.
            self._process: subprocess.Popen[bytes] | None = subprocess.Popen(
                command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, start_new_session=True
            )
        except OSError as error:
            self._process, self.fault = None, f"the process that writes cannot be started ({error.strerror})"
        theirs.close()
        self._send((str(path), metadata, options))
        self._hear(patience)

    def prepare(self, method: str, now: int, *arguments: object, **named: object) -> None:
        """Have a method of `DriveWriter` called with the next `hand`: its name, the time [ns], what else it takes."""
        self._prepared.append((method, now, arguments, named))

    def hand(self, method: str, now: int, *arguments: object, **named: object) -> None:
        """Have it called now, after what was prepared, in one parcel: what is sent takes longer than what is in it."""
        self.prepare(method, now, *arguments, **named)
        if not self.fault:
            self._send(self._prepared)
        self._prepared = []

    def poll(self) -> None:
        """Hear whether recording has ended."""
        if not self.fault:
            self._hear(0.0)

    def close(self, patience: float) -> None:
        """End the file, and wait until it is whole, at most `patience` [s]; it will be, even where nobody waits."""
        self.poll()
        self._link.close()
        if self._process is not None:
            try:
                self._process.wait(patience)
            except subprocess.TimeoutExpired:
                return

    def _send(self, content: object) -> None:
        try:
            self._link.send(pickle.dumps(content, pickle.HIGHEST_PROTOCOL))
            self.taken += 1
        except BlockingIOError:
            self.lost += 1
        except OSError as error:
            # That the other end has gone is what it last said the reason of.
            self._hear(0.0)
            self.fault = self.fault or f"the process that writes has ended ({error.strerror})"

    def _hear(self, patience: float) -> None:
        waited = select.poll()
        waited.register(self._link, select.POLLIN)
        if not waited.poll(1e3 * patience):
            return
        try:
            parcel = self._link.recv(LARGEST)
        except OSError:
            parcel = b""
        kind, words = pickle.loads(parcel) if parcel else (OVER, "the process that writes has ended")
        if kind == READY:
            self.path = Path(words)
        elif kind == OVER:
            self.fault = words
