"""Controllers of other kinds, to compare the predictive controller with; docs/recipes.md shows how to add one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from diffdrive_mpc.models.interface import FloatArray, TrackingController

LAWS = {
    name + option: law
    for name, law in {
        "pursuit": "pursuit.PursuitLaw",
        "kanayama": "kanayama.KanayamaLaw",
        "lqr": "lqr.LqrLaw",
        "mppi": "mppi.MppiLaw",
    }.items()
    for option in ("", "+slip")
}
"""Module and class of every tracking law: it acts on the predictive controller's own estimate, moved forward over the
robot's delay; with "+slip" it makes up for the estimated side-slip too."""

PEERS = dict.fromkeys(LAWS, "") | {
    "kanayama-plain": "kanayama_plain.KanayamaController",
    "rpp": "rpp.RegulatedPurePursuit",
    "rpp+stop": "seeing.PursuitThatStops",
    "mppi+grid": "seeing.MppiWithGrid",
}
"""Every peer to choose on the command line, by name: module and class, or one of `LAWS`. None takes a model."""


def make_peer(name: str, overrides: Mapping[str, object] | None = None) -> TrackingController:
    """Build the controller `name` of `PEERS`.

    `overrides` are configuration values by dotted key, of the robot at hand: a tracking law acts on an estimate that
    knows as much of it as the predictive controller does. The others only know the papers' robot.
    """
    if name in LAWS:
        from diffdrive_mpc.bench.peers.tracking_peer import make_tracking_peer  # noqa: PLC0415 - --help does without it

        return make_tracking_peer(name, overrides=overrides)
    module, _, kind = PEERS[name].partition(".")
    made: TrackingController = getattr(import_module(f"{__name__}.{module}"), kind)()
    return made


@dataclass(frozen=True, slots=True)
class PeerStep:
    """What a peer decided at one tick; satisfies `models.interface.ControlStep`.

    `solve_time` is the law's part of `step_time` [s]; estimate and prediction take the rest.
    """

    command: FloatArray
    mode: str
    message: str
    step_time: float
    solve_time: float = float("nan")
    solver: None = None
    plan: FloatArray | None = None
