"""Recorder of a drive that sends data to a writing process without blocking."""

from __future__ import annotations

import errno
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

# The writing process reads data from a socket until the other end is closed, for instance because its process died.


MAX_PARCEL = 1 << 18
"""Maximum size of a parcel [bytes]."""
READY, ENDED = "ready", "over"
"""Kinds of replies: the file has been created, or writing has ended for the given reason."""
_MAX_QUEUE = 20_000
"""Maximum number of queued parcels: some minutes of data, in case the disk is slow."""
_NICENESS = 10


def main(descriptor: int) -> None:
    """Write the data from the socket `descriptor`; the first parcel names the target file."""
    from diffdrive_mpc.models.logs.drive_log.writer import DriveWriter  # noqa: PLC0415 - the node does not write

    # Use a low priority, so that writing does not preempt the control loop on the same core.
    os.nice(_NICENESS)
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    with socket.socket(fileno=descriptor) as link:
        try:
            path, metadata, options = pickle.loads(link.recv(MAX_PARCEL))
            with _create_file(Path(path)) as stream:
                writer = DriveWriter(stream, metadata, **options)
                _reply(link, READY, stream.name)
                _write(link, writer, stream)
        except (OSError, EOFError) as error:
            _reply(link, ENDED, getattr(error, "strerror", None) or str(error))


def _write(link: socket.socket, writer: DriveWriter, stream: Any) -> None:  # noqa: ANN401 - an open file
    # A thread empties the socket; otherwise a slow disk would fill its buffer, and the sender would lose parcels.
    parcels: queue.Queue[bytes] = queue.Queue(_MAX_QUEUE)
    threading.Thread(target=_receive, args=(link, parcels), daemon=True).start()
    while parcel := parcels.get():
        for method, now, arguments, keywords in pickle.loads(parcel):
            getattr(writer, method)(now, *arguments, **keywords)
        stream.flush()
    writer.close()


def _receive(link: socket.socket, parcels: queue.Queue[bytes]) -> None:
    """Queue incoming parcels; a closed socket yields an empty parcel, which ends the drive."""
    parcel = b"?"
    while parcel:
        parcel = link.recv(MAX_PARCEL)
        parcels.put(parcel)


def _create_file(path: Path) -> Any:  # noqa: ANN401 - an open file
    """Create the file, with the next free number in its name if it exists."""
    path.parent.mkdir(parents=True, exist_ok=True)
    names = (path.with_stem(f"{path.stem}-{number}") if number else path for number in range(1000))
    for name in names:
        try:
            return name.open("xb")
        except FileExistsError:
            continue
    raise FileExistsError(errno.EEXIST, "a thousand numbered files with this name exist", str(path))


def _reply(link: socket.socket, *texts: str) -> None:
    try:
        link.send(pickle.dumps(texts))
    except OSError:
        return  # the other end is closed


if __name__ == "__main__":
    main(int(sys.argv[1]))


_BUFFER = 1 << 22
"""Requested size of the send buffer [bytes]; the system may grant less."""
Metadata = Mapping[str, Mapping[str, str]]


class DriveRecorder:
    """Recorder of one drive into a new file. Methods do not raise: a failed recording must not stop the robot.

    Parameters
    ----------
    path
        Target file; an existing file is not replaced, and the new file then has a number in its name.
    metadata
        Information about the drive.
    timeout
        Maximum time to wait for the file [s].
    **options
        Options of `DriveWriter`.

    Attributes
    ----------
    path
        The file, after its creation.
    fault
        Reason for the end of recording; empty while recording.
    sent, lost
        Number of parcels that were sent, and number that were lost because the writer was too slow.
    """

    def __init__(self, path: Path, metadata: Metadata, *, timeout: float, **options: object) -> None:
        self.path, self.fault, self.sent, self.lost = path, "", 0, 0
        self._prepared: list[tuple[object, ...]] = []
        # SOCK_SEQPACKET delivers datagrams in order, as a whole or not at all, without blocking.
        self._link, writer_link = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        self._link.setblocking(False)
        command = [sys.executable, "-m", "diffdrive_mpc.models.logs.drive_log.recorder", str(writer_link.fileno())]
        try:
            # In a separate session, Ctrl-C does not reach the writer, so it also writes the last command.
            self._process: subprocess.Popen[bytes] | None = subprocess.Popen(
                command, pass_fds=[writer_link.fileno()], stdin=subprocess.DEVNULL, start_new_session=True
            )
        except OSError as error:
            self._process, self.fault = None, f"the writing process cannot be started ({error.strerror})"
        # The process has its own copy. If this copy stayed open, the end of the process would not close the socket.
        writer_link.close()
        self._send((str(path), metadata, options))
        self._receive_reply(timeout)

    def prepare(self, method: str, now: int, *arguments: object, **keywords: object) -> None:
        """Queue a call of a method of `DriveWriter` for the next `send`: name, time [ns], arguments."""
        self._prepared.append((method, now, arguments, keywords))

    def send(self, method: str, now: int, *arguments: object, **keywords: object) -> None:
        """Send a call and all queued calls in one parcel, because each parcel is costly."""
        self.prepare(method, now, *arguments, **keywords)
        if not self.fault:
            self._send(self._prepared)
        self._prepared = []

    def poll(self) -> None:
        """Check whether the writing process has ended."""
        if not self.fault:
            self._receive_reply(0.0)

    def close(self, timeout: float) -> None:
        """End the recording and wait at most `timeout` [s] for the file; the writer also completes it afterwards."""
        self.poll()
        self._link.close()
        if self._process is not None:
            try:
                self._process.wait(timeout)
            except subprocess.TimeoutExpired:
                return

    def _send(self, content: object) -> None:
        try:
            self._link.send(pickle.dumps(content, pickle.HIGHEST_PROTOCOL))
            self.sent += 1
        except BlockingIOError:
            self.lost += 1
        except OSError as error:
            # The last reply of the process contains the reason for its end.
            self._receive_reply(0.0)
            self.fault = self.fault or f"the writing process has ended ({error.strerror})"

    def _receive_reply(self, timeout: float) -> None:
        poller = select.poll()
        poller.register(self._link, select.POLLIN)
        if not poller.poll(1e3 * timeout):
            return
        try:
            parcel = self._link.recv(MAX_PARCEL)
        except OSError:
            parcel = b""
        kind, text = pickle.loads(parcel) if parcel else (ENDED, "the writing process has ended")
        if kind == READY:
            self.path = Path(text)
        elif kind == ENDED:
            self.fault = text
