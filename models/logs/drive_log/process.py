"""Writes a drive in a process of its own: what it is handed over a socket, until the other end closes, however it ends.

A thread would take turns with its interpreter's others, some milliseconds each: more than a control loop can wait.
"""

from __future__ import annotations

import os
import pickle
import queue
import socket
import sys
import threading
from pathlib import Path
from typing import Any

from diffdrive_mpc.models.logs.drive_log.writer import DriveWriter

LARGEST = 1 << 18
"""Bytes of one parcel at most."""
READY, OVER = "ready", "over"
"""First words of what is answered: that the file is there, and that no more is written and why."""
_WAITING = 20_000
"""Parcels that wait for a slow disk at most, some minutes."""
_NICENESS = 10


def main(descriptor: int) -> None:
    """Write what comes through the socket `descriptor`, from its first parcel on, which says where to and how."""
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
    """Take in parcels as they come; an empty one, which ends the drive, is what a closed socket gives."""
    parcel = b"?"
    while parcel:
        parcel = link.recv(LARGEST)
        waiting.put(parcel)


def _new(path: Path) -> Any:  # noqa: ANN401 - an open file
    """A new file of this name, or of the next that is free."""
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
        return  # nobody listens any more


if __name__ == "__main__":
    main(int(sys.argv[1]))
