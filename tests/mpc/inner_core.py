"""The core with what its inner header declares: parts of a tick are called, and its memory is read and written."""

from __future__ import annotations

from functools import cache
from unittest.mock import patch

from diffdrive_mpc.mpc import Controller, load_config
from diffdrive_mpc.mpc.core import library
from diffdrive_mpc.mpc.core.sources import CORE, declarations


@cache
def inner_core():
    """cffi's declarations and the library that the product loads."""
    text = "\n".join((CORE / name).read_text(encoding="utf-8") for name in ("core.h", "active_set.h", "internal.h"))
    with patch.object(library, "core_declarations", lambda: declarations(text)):
        return library.load_core.__wrapped__()


class InnerController:
    """A controller of the product, its `ddmpc_controller` as `c` and its constants, which may be changed, as `k`."""

    def __init__(self, name="ssm", **changes):
        self.ffi, self.lib = inner_core()
        self.controller = Controller(load_config(name, changes))
        tick = self.controller._tick
        self.c = self.ffi.cast("ddmpc_controller *", int(tick.ffi.cast("uintptr_t", tick.c)))
        assert self.ffi.sizeof("ddmpc_controller") == self.lib.ddmpc_controller_bytes()
        self.k = self.ffi.cast("ddmpc_constants *", self.c.constants)
