"""Hands a drive to the process that writes it, and never waits while doing so."""

from __future__ import annotations

import os
import pickle
import queue
import select
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffdrive_mpc.models.logs.drive_log.writer import DriveWriter

# Write a drive in a separate process: it reads data from a socket until the other end closes for any reason.


LARGEST = 1 << 18
"""Bytes of one parcel at most."""
READY, OVER = "ready", "over"
"""First word of the answers: that the file is there, and that no more is written and why."""
_WAITING = 20_000
"""Parcels that wait for a slow disk at most, some minutes."""
_NICENESS = 10


def main(descriptor: int) -> None:
    """Write data from the socket `descriptor`; its first parcel names the target."""
    from diffdrive_mpc.models.logs.drive_log.writer import DriveWriter  # noqa: PLC0415 - the node does not write

    # It does not interrupt, on its core, the loop that hands it something.
    os.nice(_NICENESS)
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    with socket.socket(fileno=descriptor) as link:
        try:
            path, metadata, options = pickle.loads(link.recv(LARGEST))
            with _new(Path(path)) as stream:
                writer = DriveWriter(stream, metadata, **options)
                _answer(link, READY, stream.name)
                _write(link, writer, stream)
        except (OSError, EOFError) as error:
            _answer(link, OVER, getattr(error, "strerror", None) or str(error))


def _write(link: socket.socket, writer: DriveWriter, stream: Any) -> None:  # noqa: ANN401 - an open file
    waiting: queue.Queue[bytes] = queue.Queue(_WAITING)
    threading.Thread(target=_receive, args=(link, waiting), daemon=True).start()
    while parcel := waiting.get():
        for method, now, arguments, named in pickle.loads(parcel):
            getattr(writer, method)(now, *arguments, **named)
        stream.flush()
    writer.close()


def _receive(link: socket.socket, waiting: queue.Queue[bytes]) -> None:
    """Take in parcels as they come; a closed socket gives an empty one, which ends the drive."""
    parcel = b"?"
    while parcel:
        parcel = link.recv(LARGEST)
        waiting.put(parcel)


def _new(path: Path) -> Any:  # noqa: ANN401 - an open file
    """Create a file of this name, or of the next free name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    names = (path.with_stem(f"{path.stem}-{number}") if number else path for number in range(1000))
    for name in names:
        try:
            return name.open("xb")
        except FileExistsError:
            continue
    raise FileExistsError(17, "there are a thousand files of this name", str(path))


def _answer(link: socket.socket, *words: str) -> None:
    try:
        link.send(pickle.dumps(words))
    except OSError:
        return  # the other end is closed


if __name__ == "__main__":
    main(int(sys.argv[1]))


_BUFFER = 1 << 22
"""Maximum pending bytes; the system may grant less."""
Metadata = Mapping[str, Mapping[str, str]]


class DriveRecorder:
    """Records one drive into a new file. After the constructor nothing raises: a recording is not worth a robot.

    Parameters
    ----------
    path
        The file; an existing one of that name is kept, and the new one gets a number.
    metadata
        Information about the drive for the file.
    patience
        Longest time to wait for the file [s].
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
        command = [sys.executable, "-m", "diffdrive_mpc.models.logs.drive_log.recorder", str(theirs.fileno())]
        try:
            # A separate session, so that Ctrl-C reaches the robot only, and the file ends after its last command.
            self._process: subprocess.Popen[bytes] | None = subprocess.Popen(
                command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, start_new_session=True
            )
        except OSError as error:
            self._process, self.fault = None, f"the process that writes cannot be started ({error.strerror})"
        theirs.close()
        self._send((str(path), metadata, options))
        self._hear(patience)

    def prepare(self, method: str, now: int, *arguments: object, **named: object) -> None:
        """Prepare a call of a method of `DriveWriter` for the next `hand`: name, time [ns], arguments."""
        self._prepared.append((method, now, arguments, named))

    def hand(self, method: str, now: int, *arguments: object, **named: object) -> None:
        """Send a call and the prepared ones at once, since sending takes longer than its content."""
        self.prepare(method, now, *arguments, **named)
        if not self.fault:
            self._send(self._prepared)
        self._prepared = []

    def poll(self) -> None:
        """Check for the end of recording."""
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
            # The end of the other process is reported with its last message.
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
