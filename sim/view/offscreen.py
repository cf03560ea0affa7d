"""Off-screen pictures of MuJoCo on machines with and without a graphics card: EGL or OSMesa, whichever works."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.sim.view.painter import READY
from diffdrive_mpc.sim.view.shots import Shots

TRIED = ("egl", "osmesa") if sys.platform.startswith("linux") else ("",)
"""Values of MUJOCO_GL, in order, where the user has not set it; other systems have one way to draw."""
_CHOICE = "MUJOCO_GL"

Picture = NDArray[np.uint8]


class NoOpenGLError(DiffdriveMpcError):
    """Nothing on this machine draws off-screen. One line: what was tried, why it failed, remedy."""


@contextmanager
def painted(shots: Shots, environment: Mapping[str, str] = os.environ) -> Iterator[Iterator[Picture]]:
    """Give the pictures of `shots` one by one, each (height, width, 3) red, green, blue.

    Another process paints them, one ahead of the one taken last.

    Raises
    ------
    NoOpenGLError
        If MuJoCo can draw with nothing.
    """
    choice = environment.get(_CHOICE, "").strip().lower()
    failures = []
    with tempfile.TemporaryDirectory(prefix="diffdrive-mpc-") as folder:
        file = Path(folder) / "shots.npz"
        shots.save(file)
        for backend in (choice,) if choice else TRIED:
            with _painter(file, {**environment, _CHOICE: backend}) as (process, errors):
                assert process.stdout is not None
                if process.stdout.readline() == READY:
                    yield _pictures(process, errors, shots)
                    return
                process.wait()
                failures.append(f"{backend}: {_last_line(errors)}")
    raise NoOpenGLError(
        f"MuJoCo cannot draw off-screen ({'; '.join(failures)}): install libegl1 and libgl1-mesa-dri, or libosmesa6 "
        f"(Debian, Ubuntu)"
        + (f", or unset {_CHOICE}, which is '{choice}'" if choice else "")
        + "; without --render the view from above needs none of it"
    )


@contextmanager
def _painter(file: Path, environment: Mapping[str, str]) -> Iterator[tuple[subprocess.Popen[bytes], Path]]:
    errors = file.with_suffix(".log")
    command = [sys.executable, "-m", "diffdrive_mpc.sim.view.painter", str(file)]
    with (
        errors.open("wb") as log,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, env=environment) as process,
    ):
        try:
            yield process, errors
        finally:
            process.kill()


def _pictures(process: subprocess.Popen[bytes], errors: Path, shots: Shots) -> Iterator[Picture]:
    width, height = shots.size
    assert process.stdout is not None
    for _ in range(len(shots.time)):
        picture = process.stdout.read(3 * width * height)
        if len(picture) < 3 * width * height:
            raise NoOpenGLError(f"MuJoCo stopped painting: {_last_line(errors)}")
        yield np.frombuffer(picture, dtype=np.uint8).reshape(height, width, 3)


def _last_line(errors: Path) -> str:
    """What went wrong, in one line; what Python says of its own end follows the cause and is left out."""
    lines = errors.read_text(encoding="utf-8", errors="replace").splitlines()
    printed = [
        line for line in lines if line.strip() and not line[0].isspace() and not line.startswith("Exception ignored")
    ]
    causes = [line for line in printed if "Error" in line.partition(":")[0]]
    return (causes or printed or ["it ended without a word"])[0].rstrip(". ")
