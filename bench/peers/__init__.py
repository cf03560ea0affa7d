"""Controllers of other kinds, to compare the predictive controller with; docs/recipes/peer.md shows how to add one."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from diffdrive_mpc.models.interface import FloatArray, TrackingController

PEERS = {"kanayama": "kanayama.KanayamaController"}
"""Module and class of every peer to choose on the command line, by name. A peer has no velocity model of ours."""


def make_peer(name: str) -> TrackingController:
    """A fresh controller of a name in `PEERS`."""
    module, _, kind = PEERS[name].partition(".")
    made: TrackingController = getattr(import_module(f"{__name__}.{module}"), kind)()
    return made


@dataclass(frozen=True, slots=True)
class PeerStep:
    """What a peer decided at one tick; satisfies `models.interface.ControlStep`.

    `solve_time` is what its law took of `step_time` [s]; the rest went into estimate and prediction.
    """

    command: FloatArray
    mode: str
    message: str
    step_time: float
    solve_time: float = float("nan")
    solver: None = None
    plan: FloatArray | None = None
