"""What draws: a display, OpenGL with and without one, and what makes films."""

from __future__ import annotations

from diffdrive_mpc.app.doctor.machine import Finding, Machine

_BACKENDS = {"EGL": "egl", "OSMesa": "osmesa"}
"""Libraries that draw without a display, and MuJoCo's names for them."""


def display(machine: Machine) -> Finding:
    """A screen to open windows on."""
    for name in ("WAYLAND_DISPLAY", "DISPLAY"):
        if machine.variable(name):
            return Finding("display", "ok", f"{name}={machine.variable(name)}", "windows open")
    return Finding(
        "display", "missing", "none", "no viewer windows; figures, films and reports are files and need none"
    )


def off_screen(machine: Machine) -> Finding:
    """OpenGL without a display."""
    there = [name for name in _BACKENDS if machine.library(name)]
    chosen = machine.variable("MUJOCO_GL")
    libraries = (
        ", ".join(there)
        + (f", MUJOCO_GL={chosen}" if chosen else "")
        + (", /dev/dri" if machine.there("dev/dri") else "")
    )
    if not there:
        return Finding(
            "OpenGL off screen",
            "missing",
            libraries.strip(", ") or "none",
            "MuJoCo's own pictures cannot be rendered: apt install libegl1 libosmesa6",
        )
    if chosen and chosen not in (*(_BACKENDS[name] for name in there), "glfw"):
        means = f"its library is not there: set MUJOCO_GL={_BACKENDS[there[0]]}"
        return Finding("OpenGL off screen", "warn", libraries, means)
    return Finding("OpenGL off screen", "ok", libraries, "MuJoCo's own pictures can be rendered")


def ffmpeg(machine: Machine) -> Finding:
    """What writes MP4."""
    if machine.program("ffmpeg"):
        return Finding("ffmpeg", "ok", "found", "films are MP4")
    return Finding("ffmpeg", "missing", "none", "films are WebP or GIF instead of MP4: apt install ffmpeg")
