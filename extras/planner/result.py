"""A plan: the timed reference, what it is predicted to take, and how it was found."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from diffdrive_mpc.extras.planner.inputs import Objective
from diffdrive_mpc.extras.planner.search import Found, Piece
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.trajectories.trajectory import Trajectory

POLISHED, UNFINISHED, SEARCHED = "polished", "unfinished", "search"
"""IPOPT found a minimum; it did not finish, and what it has is a plan; the way of the search stands."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A timed reference from rest to rest, and what it is predicted to take.

    Attributes
    ----------
    minimise
        What it is the least of.
    trajectory
        The reference.
    poses
        (n + 1, 3) at the sample times x, y [m], theta [rad, unwrapped].
    commands
        (n, 2) v [m/s], omega [rad/s], held for a sample each.
    power
        (n,) predicted [W].
    sample_time
        [s].
    energy
        Predicted, of `commands` [J]; what speeding up takes is not in it.
    duration
        [s].
    length
        Of the way of the body's middle [m].
    pieces
        Of the search: inputs that are held, before they were made smooth.
    sharpest
        Least commanded radius that was allowed [m].
    clearance
        Least distance from an obstacle [m]; infinite where there is none.
    search
        What the search has to say: cost, lower bound, states.
    status
        "polished"; "unfinished" where IPOPT did not converge and what it has is proven to be a plan all the same;
        "search" where it failed and the search's way stands, at rest between its pieces.
    solver
        IPOPT's own words.
    """

    minimise: Objective
    trajectory: Trajectory
    poses: FloatArray
    commands: FloatArray
    power: FloatArray
    sample_time: float
    energy: float
    duration: float
    length: float
    pieces: tuple[Piece, ...]
    sharpest: float
    clearance: float
    search: Found
    status: str
    solver: str

    @property
    def rows(self) -> FloatArray:
        """(n + 1, 4) t [s], x, y [m], theta [rad]: what `load_trajectory` reads."""
        return np.column_stack([self.sample_time * np.arange(len(self.poses)), self.poses])

    def amount(self, objective: Objective) -> float:
        """Energy [J], duration [s] or length [m]."""
        return {"energy": self.energy, "time": self.duration, "distance": self.length}[objective]

    def of(self, minimise: Objective, search: Found) -> Plan:
        """The same, as what was found for `minimise`."""
        return replace(self, minimise=minimise, search=search)
