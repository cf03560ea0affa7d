"""A plan: the timed reference, its predicted energy and time, and the method."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.trajectories.trajectory import Trajectory
from diffdrive_mpc_extras.planner.inputs import Objective
from diffdrive_mpc_extras.planner.schedule import Schedule
from diffdrive_mpc_extras.planner.search import Piece, PlanSearchResult
from diffdrive_mpc_extras.turn_costs import TurnCosts

POLISHED, UNFINISHED, SEARCHED = "polished", "unfinished", "search"
"""IPOPT found a minimum; it did not finish, but its result is a plan; the way of the search is used."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A timed reference from rest to rest, with its predicted energy and time.

    Attributes
    ----------
    minimise
        Quantity that was minimised.
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
        Predicted, of `commands` [J]; the energy of accelerating is not included.
    duration
        [s].
    length
        Length of the way of the body's middle [m].
    pieces
        Pieces of the search: inputs that are held, before they were made smooth.
    sharpest
        Least commanded radius that was allowed [m].
    clearance
        Least distance from an obstacle [m]; infinite where there is none.
    search
        Results of the search: cost, lower bound, states.
    status
        "polished"; "unfinished" where IPOPT did not converge, but its result fulfils all conditions of a plan; "search"
        where it failed and the search's way is used, with a stop between its pieces.
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
    search: PlanSearchResult
    status: str
    solver: str

    @property
    def rows(self) -> FloatArray:
        """(n + 1, 4) t [s], x, y [m], theta [rad]: the format of `load_trajectory`."""
        return np.column_stack([self.sample_time * np.arange(len(self.poses)), self.poses])

    def amount(self, objective: Objective) -> float:
        """Return energy [J], duration [s] or length [m]."""
        return {"energy": self.energy, "time": self.duration, "distance": self.length}[objective]

    def for_objective(self, minimise: Objective, search: PlanSearchResult) -> Plan:
        """Return the plan as a result for `minimise`."""
        return replace(self, minimise=minimise, search=search)


# From nodes to a timed reference: commands at the sample time, poses by the slip law, and the end made exact.


_ROUNDS = 12
_EXACT = 1e-9


def sampled(schedule: Schedule, durations: FloatArray, rates: FloatArray, dt: float) -> FloatArray:
    """Sample commands (n, 2): the mean over each sample between the nodes, at rest at the end."""
    times = np.concatenate([[0.0], np.cumsum(schedule.steps(durations))])
    edges = dt * np.arange(int(np.ceil(times[-1] / dt - 1e-9)) + 1)
    values = np.stack([schedule.speeds, rates], -1)
    # Integrals of straight pieces are exact: their means over samples cover what the nodes cover.
    whole = np.concatenate([np.zeros((1, 2)), np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(times)[:, None], 0)])
    interval = np.clip(np.searchsorted(times, edges, side="right") - 1, 0, len(times) - 2)
    span = np.diff(times)[interval]
    into = np.clip(edges - times[interval], 0.0, span)
    slope = (values[interval + 1] - values[interval]) / np.maximum(span, 1e-12)[:, None]
    area = whole[interval] + values[interval] * into[:, None] + 0.5 * slope * into[:, None] ** 2
    return np.asarray(np.diff(area, axis=0) / dt)


def driven(costs: TurnCosts, commands: FloatArray, start: FloatArray, dt: float) -> FloatArray:
    """Integrate commands (..., n, 2) held for `dt` [s] to poses (..., n + 1, 3) by exact arcs; theta is not wrapped."""
    v, lateral, omega = np.moveaxis(costs.twist(commands), -1, 0)
    turned = np.cumsum(omega * dt, axis=-1)
    middle = start[2] + turned - 0.5 * omega * dt
    reach = dt * np.sinc(0.5 * omega * dt / np.pi)
    c, s = np.cos(middle), np.sin(middle)
    x, y = np.cumsum(reach * (v * c - lateral * s), -1), np.cumsum(reach * (v * s + lateral * c), -1)
    moved = np.stack([x, y, turned], axis=-1)
    origin = np.zeros((*moved.shape[:-2], 1, 3))
    return np.asarray(start + np.concatenate([origin, moved], axis=-2))


def made_exact(
    costs: TurnCosts,
    schedule: Schedule,
    durations: FloatArray,
    rates: FloatArray,
    start: FloatArray,
    goal: FloatArray,
    dt: float,
) -> tuple[FloatArray, FloatArray]:
    """Adjust yaw rates (nodes,) and durations (phases,) minimally so that the sampled commands end at `goal`.

    Newton's method on the end pose with the smallest change, each unknown over its own size.
    """
    bound, exact, lasting = schedule.most, rates.copy(), durations.copy()
    loose = np.flatnonzero(bound > 0)
    free = np.flatnonzero(schedule.free)
    step = 1e-5
    for _ in range(_ROUNDS):
        commands = sampled(schedule, lasting, exact, dt)
        end = driven(costs, commands, start, dt)[-1]
        off = goal - end
        if np.abs(off).max() < _EXACT:
            break
        columns = []
        for node in loose:
            moved = exact.copy()
            moved[node] += step
            columns.append((driven(costs, sampled(schedule, lasting, moved, dt), start, dt)[-1] - end) / step)
        for unknown in free:
            changed = lasting.copy()
            changed[unknown] += step
            columns.append((driven(costs, sampled(schedule, changed, exact, dt), start, dt)[-1] - end) / step)
        # A node at its limit may go back only a little: it is moved less than those with room.
        room = 0.02 + (bound[loose] - np.abs(exact[loose])) / bound[loose]
        size = np.concatenate([room * bound[loose], np.full(len(free), 0.3)])
        slope = np.array(columns).T * size
        change = size * (np.linalg.pinv(slope) @ off)
        exact[loose] += change[: len(loose)]
        lasting[free] = np.maximum(lasting[free] + change[len(loose) :], 1e-3)
    return exact, lasting
