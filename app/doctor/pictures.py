"""What draws: a display, OpenGL with and without one, and what makes films."""

from __future__ import annotations

from diffdrive_mpc.app.doctor.machine import Machine, MachineFinding

_BACKENDS = {"EGL": "egl", "OSMesa": "osmesa"}
"""Libraries that draw without a display, and MuJoCo's names for them."""


def display(machine: Machine) -> MachineFinding:
    """A screen to open windows on."""
    for name in ("WAYLAND_DISPLAY", "DISPLAY"):
        if machine.variable(name):
            return MachineFinding("display", "ok", f"{name}={machine.variable(name)}", "windows open")
    return MachineFinding(
        "display", "missing", "none", "no viewer windows; figures, films and reports are files and need none"
    )


def off_screen(machine: Machine) -> MachineFinding:
    """OpenGL without a display."""
    there = [name for name in _BACKENDS if machine.library(name)]
    chosen = machine.variable("MUJOCO_GL")
    libraries = (
        ", ".join(there)
        + (f", MUJOCO_GL={chosen}" if chosen else "")
        + (", /dev/dri" if machine.there("dev/dri") else "")
    )
    if not there:
        return MachineFinding(
            "OpenGL off screen",
            "missing",
            libraries.strip(", ") or "none",
            "MuJoCo's own pictures cannot be rendered: apt install libegl1 libosmesa6",
        )
    if chosen and chosen not in (*(_BACKENDS[name] for name in there), "glfw"):
        means = f"its library is not there: set MUJOCO_GL={_BACKENDS[there[0]]}"
        return MachineFinding("OpenGL off screen", "warn", libraries, means)
    return MachineFinding("OpenGL off screen", "ok", libraries, "MuJoCo's own pictures can be rendered")


def ffmpeg(machine: Machine) -> MachineFinding:
    """What writes MP4."""
    if machine.program("ffmpeg"):
        return MachineFinding("ffmpeg", "ok", "found", "films are MP4")
    return MachineFinding("ffmpeg", "missing", "none", "films are WebP or GIF instead of MP4: apt install ffmpeg")
