"""Tracking controllers with which the predictive controller is compared; docs/recipes.md shows how to add a peer.

Packages register peers in the entry-point group `diffdrive_mpc.peers`: a `TrackingLaw`, or a class whose constructor
takes no arguments.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from diffdrive_mpc.models.plug_ins import plug_in, plug_in_names

if TYPE_CHECKING:
    from diffdrive_mpc.models.interface import FloatArray, TrackingController

GAINS = Path(__file__).with_name("gains.yaml")
"""File with the gains of the laws in this folder, by name of the peer; tuned by the study `peers`."""
_KINDS = {"pursuit": "PursuitLaw", "kanayama": "KanayamaLaw", "lqr": "LqrLaw"}
LAWS = tuple(name + option for name in _KINDS for option in ("", "+slip"))
"""Names of the tracking laws of this folder.

A law uses the estimate of the predictive controller, predicted over the delay of the robot. A name with "+slip" also
compensates the estimated side-slip.
"""
PEERS = (*LAWS, *plug_in_names("peers"))
"""Names of all peers. Peers have no option for the model."""


class TrackingLaw(NamedTuple):
    """Peer that consists of a tracking law and its gains."""

    kind: Any
    """Class that satisfies `tracking_peer.Law`."""
    gains: Path = GAINS
    """File of gains by name of the peer."""


def find_peer(name: str) -> TrackingLaw | Callable[[], TrackingController]:
    """Return the law of a peer, or the class of any other peer; raise MissingPackageError for an unknown peer."""
    if name not in LAWS:
        peer: TrackingLaw | Callable[[], TrackingController] = plug_in("peers", name)
        return peer
    module = name.partition("+")[0]
    return TrackingLaw(getattr(import_module(f"{__name__}.{module}"), _KINDS[module]))


def accepts_settings(name: str) -> bool:
    """Return True if a peer accepts configuration values; peers with a tracking law use the controller's estimator."""
    return isinstance(find_peer(name), TrackingLaw)


def make_peer(
    name: str, overrides: Mapping[str, object] | None = None, gains: Mapping[str, float] | None = None
) -> TrackingController:
    """Create a peer by name.

    Parameters
    ----------
    name
        One of `PEERS`.
    overrides
        Configuration values of the robot by dotted key, for the estimator of a peer with a tracking law. Other peers
        support the robot of the papers only.
    gains
        Gains that replace the gains of the file.
    """
    peer = find_peer(name)
    if not isinstance(peer, TrackingLaw):
        return peer()
    from diffdrive_mpc.bench.peers import tracking_peer  # noqa: PLC0415 - --help does not need it

    law_gains = tracking_peer.law_kind(name).gains(**gains) if gains else None
    return tracking_peer.make_tracking_peer(name, law_gains, overrides=overrides)


@dataclass(frozen=True, slots=True)
class PeerStep:
    """Result of a peer at one tick; satisfies `models.interface.ControlStep`.

    `solve_time` is the part of `step_time` that the law takes [s]; estimation and prediction take the rest.
    """

    command: FloatArray
    mode: str
    message: str
    step_time: float
    solve_time: float = float("nan")
    solver: None = None
    plan: FloatArray | None = None
