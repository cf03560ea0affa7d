"""Tracking controllers to compare the predictive controller with; docs/recipes.md shows how to add one.

Packages register peers in the group `diffdrive_mpc.peers`: a `TrackingLaw`, or a class whose constructor has no
arguments.
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
"""File of gains of the laws in this folder by the name of the peer, as tuned by the study `peers`."""
_KINDS = {"pursuit": "PursuitLaw", "kanayama": "KanayamaLaw", "lqr": "LqrLaw"}
LAWS = tuple(name + option for name in _KINDS for option in ("", "+slip"))
"""Peers of this folder: a tracking law on the predictive controller's estimate, predicted over the robot's delay; with
"+slip" it also compensates the estimated side-slip."""
PEERS = (*LAWS, *plug_in_names("peers"))
"""Names of all peers. A peer takes no model."""


class TrackingLaw(NamedTuple):
    """A tracking law as a peer."""

    kind: Any
    """class, a `tracking_peer.Law`"""
    gains: Path = GAINS
    """file of gains by the name of the peer"""


def find_peer(name: str) -> TrackingLaw | Callable[[], TrackingController]:
    """Return the law of a peer, or the class of a peer without a law; raise MissingPackageError if it is unknown."""
    if name not in LAWS:
        peer: TrackingLaw | Callable[[], TrackingController] = plug_in("peers", name)
        return peer
    module = name.partition("+")[0]
    return TrackingLaw(getattr(import_module(f"{__name__}.{module}"), _KINDS[module]))


def takes_settings(name: str) -> bool:
    """Return True if a peer takes configuration values: it acts on the predictive controller's estimate."""
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
        Configuration values of the robot by dotted key, for a tracking law: its estimator then has the same data of the
        robot as the predictive controller. Other peers are configured for the papers' robot only.
    gains
        Gains that replace the shipped ones.
    """
    peer = find_peer(name)
    if not isinstance(peer, TrackingLaw):
        return peer()
    from diffdrive_mpc.bench.peers import tracking_peer  # noqa: PLC0415 - --help does not need it

    chosen = tracking_peer.law_kind(name).gains(**gains) if gains else None
    return tracking_peer.make_tracking_peer(name, chosen, overrides=overrides)


@dataclass(frozen=True, slots=True)
class PeerStep:
    """Decision of a peer at one tick; satisfies `models.interface.ControlStep`.

    `solve_time` is the law's part of `step_time` [s]; estimate and prediction take the rest.
    """

    command: FloatArray
    mode: str
    message: str
    step_time: float
    solve_time: float = float("nan")
    solver: None = None
    plan: FloatArray | None = None
