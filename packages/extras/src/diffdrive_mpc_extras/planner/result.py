"""Result of the planner: the timed reference, its predicted energy and time, and its sampling."""

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
"""Status: IPOPT converged; IPOPT did not converge, but its result is valid; the path of the search is used."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Timed reference from rest to rest, with its predicted energy and time.

    Attributes
    ----------
    minimise
        Quantity that was minimised.
    trajectory
        Reference for the controller.
    poses
        (n + 1, 3) poses x, y [m], theta [rad, unwrapped] at the sample times.
    commands
        (n, 2) commands v [m/s], omega [rad/s], each held for a sample.
    power
        (n,) predicted power [W].
    sample_time
        Sample time [s].
    energy
        Predicted energy of `commands` [J], without the energy for acceleration.
    duration
        Duration [s].
    length
        Path length of the centre of the body [m].
    pieces
        Pieces of the search, before the optimisation.
    sharpest
        Minimum allowed commanded radius [m].
    clearance
        Minimum distance from an obstacle [m]; infinity if there is none.
    search
        Results of the search: cost, lower bound, states.
    status
        "polished"; "unfinished" if IPOPT did not converge, but its result is valid; "search" if IPOPT failed and the
        path of the search is used, with a stop between its pieces.
    solver
        Status text of IPOPT.
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
        """(n + 1, 4) t [s], x, y [m], theta [rad], in the format of `load_trajectory`."""
        return np.column_stack([self.sample_time * np.arange(len(self.poses)), self.poses])

    def amount(self, objective: Objective) -> float:
        """Return energy [J], duration [s] or length [m]."""
        return {"energy": self.energy, "time": self.duration, "distance": self.length}[objective]

    def for_objective(self, minimise: Objective, search: PlanSearchResult) -> Plan:
        """Return the plan as a result for `minimise`."""
        return replace(self, minimise=minimise, search=search)


# Conversion of nodes to sample_commands commands and poses that end exactly at the goal.
_MAX_ITERATIONS = 12
_TOLERANCE = 1e-9


def sample_commands(schedule: Schedule, durations: FloatArray, rates: FloatArray, dt: float) -> FloatArray:
    """Sample the schedule to commands (n, 2), as means over each sample; the last command ends at rest."""
    times = np.concatenate([[0.0], np.cumsum(schedule.steps(durations))])
    edges = dt * np.arange(int(np.ceil(times[-1] / dt - 1e-9)) + 1)
    values = np.stack([schedule.speeds, rates], -1)
    # Means over the samples preserve the integral of the piecewise linear commands.
    integral = np.concatenate(
        [np.zeros((1, 2)), np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(times)[:, None], 0)]
    )
    interval = np.clip(np.searchsorted(times, edges, side="right") - 1, 0, len(times) - 2)
    span = np.diff(times)[interval]
    elapsed = np.clip(edges - times[interval], 0.0, span)
    slope = (values[interval + 1] - values[interval]) / np.maximum(span, 1e-12)[:, None]
    area = integral[interval] + values[interval] * elapsed[:, None] + 0.5 * slope * elapsed[:, None] ** 2
    return np.asarray(np.diff(area, axis=0) / dt)


def integrate_commands(costs: TurnCosts, commands: FloatArray, start: FloatArray, dt: float) -> FloatArray:
    """Integrate commands (..., n, 2), held for `dt` [s], to poses (..., n + 1, 3) by exact arcs; theta is unwrapped."""
    v, lateral, omega = np.moveaxis(costs.twist(commands), -1, 0)
    angles = np.cumsum(omega * dt, axis=-1)
    middle = start[2] + angles - 0.5 * omega * dt
    reach = dt * np.sinc(0.5 * omega * dt / np.pi)
    c, s = np.cos(middle), np.sin(middle)
    x, y = np.cumsum(reach * (v * c - lateral * s), -1), np.cumsum(reach * (v * s + lateral * c), -1)
    moved = np.stack([x, y, angles], axis=-1)
    origin = np.zeros((*moved.shape[:-2], 1, 3))
    return np.asarray(start + np.concatenate([origin, moved], axis=-2))


def match_goal(
    costs: TurnCosts,
    schedule: Schedule,
    durations: FloatArray,
    rates: FloatArray,
    start: FloatArray,
    goal: FloatArray,
    dt: float,
) -> tuple[FloatArray, FloatArray]:
    """Adjust yaw rates (nodes,) and durations (phases,) so that the sampled commands end at `goal`.

    Newton's method on the end pose, with the minimum-norm change of the scaled variables.
    """
    bound, yaw_rates, phase_durations = schedule.max_yaw_rate, rates.copy(), durations.copy()
    loose = np.flatnonzero(bound > 0)
    free = np.flatnonzero(schedule.free)
    step = 1e-5
    for _ in range(_MAX_ITERATIONS):
        commands = sample_commands(schedule, phase_durations, yaw_rates, dt)
        end = integrate_commands(costs, commands, start, dt)[-1]
        error = goal - end
        if np.abs(error).max() < _TOLERANCE:
            break
        columns = []
        for node in loose:
            moved = yaw_rates.copy()
            moved[node] += step
            columns.append(
                (integrate_commands(costs, sample_commands(schedule, phase_durations, moved, dt), start, dt)[-1] - end)
                / step
            )
        for unknown in free:
            changed = phase_durations.copy()
            changed[unknown] += step
            columns.append(
                (integrate_commands(costs, sample_commands(schedule, changed, yaw_rates, dt), start, dt)[-1] - end)
                / step
            )
        # The scale of a node is smaller near its limit.
        room = 0.02 + (bound[loose] - np.abs(yaw_rates[loose])) / bound[loose]
        size = np.concatenate([room * bound[loose], np.full(len(free), 0.3)])
        slope = np.array(columns).T * size
        change = size * (np.linalg.pinv(slope) @ error)
        yaw_rates[loose] += change[: len(loose)]
        phase_durations[free] = np.maximum(phase_durations[free] + change[len(loose) :], 1e-3)
    return yaw_rates, phase_durations
