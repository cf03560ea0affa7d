"""Tracking problem of `mpc.problem` in stages, for peers that solve multistage optimal control problems.

The state of a stage is z = (x, pose, past): the n states of the velocity model, the pose, and the last `memory`
commands before the stage, oldest first. Stage k has the parameters p_k, which `ROWS` names; the state of the first
stage is given.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from diffdrive_mpc.bench.peers.tracking_peer import slew_step
from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import arc_displacement
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.estimate import Estimate
from diffdrive_mpc.mpc.problem.formulas import sliding
from diffdrive_mpc.mpc.problem.margin import with_increments
from diffdrive_mpc.mpc.solver.backend import Program

ROWS = (
    *("x", "y", "theta", "heading"),
    *("v_feed_forward", "omega_feed_forward"),
    *("v_gain", "omega_gain", "v_offset", "omega_offset", "turn_left"),
    *("side_slip", "ahead", "slide_x", "slide_y"),
    *("v_ramp", "omega_ramp"),
    *("v_limit", "omega_limit", "right_limit", "left_limit", "corridor"),
)
"""Names of the parameters of a stage, in order; their values change from tick to tick."""


@dataclass(frozen=True)
class StageProblem:
    """Problem for a peer, whose process requires only CasADi and NumPy to read it.

    The cost is the sum of three terms. For k = 0 to N - 1: half of effort(z_k, u_k, p_k)^2, weighted by
    `effort_weights`. For k = 1 to N: half of tracking(z_k, p_k)^2, weighted by `tracking_weights`, and multiplied by
    `terminal` at k = N. For k = 1 to N: soft s + soft_quadratic s^2 / 2 for each amount s by which the magnitude of a
    value in soft_values(z_k, p_k) exceeds its limit in p_k. The hard constraints are z_{k+1} = step(z_k, u_k, p_k),
    |u_k| <= box and |u_k - u_{k-1}| <= slew.

    Attributes
    ----------
    horizon, states, parameters
        Horizon N, and the lengths of z and p.
    box, slew
        Bounds (2,) of the command [m/s, rad/s] and of its increments; the last two values of z_k are u_{k-1}.
    tracking_weights, effort_weights, terminal, soft, soft_quadratic
        Weights (3,) and (4,), and scalar weights; see `mpc.config.schema.Weights`.
    step, tracking, effort, soft_values
        Serialised CasADi functions. `step` maps (z, u, p) to the next z. `tracking` maps (z, p) to the errors along and
        across the path and in heading. `effort` maps (z, u, p) to the deviation from the feed-forward, and to the
        increment minus that of the feed-forward. `soft_values` maps (z, p) to the five values with soft limits.
    """

    horizon: int
    states: int
    parameters: int
    box: FloatArray
    slew: FloatArray
    tracking_weights: FloatArray
    effort_weights: FloatArray
    terminal: float
    soft: float
    soft_quadratic: float
    step: str
    tracking: str
    effort: str
    soft_values: str


def stage_problem(config: ControllerConfig, model: DiscreteModel) -> StageProblem:
    """Build the problem of a controller with configuration `config` and discrete-time `model`."""
    n, memory = model.order, model.memory
    size = n + 3 + 2 * memory
    z, u, p = ca.SX.sym("z", size), ca.SX.sym("u", 2), ca.SX.sym("p", len(ROWS))
    x, pose = z[:n], z[n : n + 3]
    commands = ca.vertcat(z[n + 3 :], u)
    reference, heading, feed_forward, gains, offset = p[:3], p[3], p[4:6], p[6:8], p[8:10]
    turn_left, side_slip, ahead = p[10], p[11], p[12]
    point = gains * (ca.DM(model.C) @ x + offset)
    current_input = ca.vertcat(*(commands[2 * (memory - int(delay)) + i] for i, delay in enumerate(model.delay)))
    previous_input = ca.vertcat(*(commands[2 * (memory - int(delay) - 1) + i] for i, delay in enumerate(model.delay)))
    next_state = ca.DM(model.A) @ x + ca.DM(model.B0) @ current_input + ca.DM(model.B1) @ previous_input
    mean_twist = _body_twist(turn_left, (point + gains * (ca.DM(model.C) @ next_state + offset)) / 2)
    along, across = sliding(pose[2] + mean_twist[1] * model.dt / 2, mean_twist[1], p[13], p[14])
    lateral = -(ahead + side_slip * mean_twist[0]) * mean_twist[1] + across
    next_pose = pose + arc_displacement(pose[2], mean_twist[0] + along, mean_twist[1], ca.SX(model.dt), lateral)
    c, s = ca.cos(reference[2]), ca.sin(reference[2])
    error = pose - reference
    across = c * error[1] - s * error[0]
    half = 0.5 * config.wheels.track
    rim = point / gains
    soft = ca.vertcat(_body_twist(turn_left, point), rim[0] + half * rim[1], rim[0] - half * rim[1], across)
    w, limits = with_increments(config, model).weights, config.limits
    return StageProblem(
        horizon=config.horizon,
        states=size,
        parameters=len(ROWS),
        box=np.array([limits.v, limits.omega]),
        slew=slew_step(limits, model.dt),
        tracking_weights=np.array([w.along, w.across, w.heading]),
        effort_weights=np.array([w.v, w.omega, w.v_increment, w.omega_increment]),
        terminal=w.terminal,
        soft=w.soft,
        soft_quadratic=w.soft_quadratic,
        step=_serialise("step", [z, u, p], ca.vertcat(next_state, next_pose, commands[2:])),
        tracking=_serialise("tracking", [z, p], ca.vertcat(c * error[0] + s * error[1], across, pose[2] - heading)),
        effort=_serialise("effort", [z, u, p], ca.vertcat(u - feed_forward, u - commands[-4:-2] - p[15:17])),
        soft_values=_serialise("soft_values", [z, p], soft),
    )


def stage_data(program: Program, estimate: Estimate, past: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute the state of the first stage (z,) and the parameters of all stages (N + 1, p) for one tick.

    Parameters
    ----------
    program, estimate
        Problem of the tick in the memory of the core, and the estimate on which the problem is based.
    past
        Commands (memory, 2) sent before the tick, oldest first.

    Raises
    ------
    ValueError
        If the last command of the tick differs from the newest command in `past`; the state contains only the latter.
    """
    if not np.array_equal(program.last_command, past[-1]):
        raise ValueError("the last command differs from the newest past command; peers cannot represent both")
    N, slip = len(program.feed_forward), estimate.slip
    parameters = np.zeros((N + 1, len(ROWS)))
    parameters[:, :4] = program.aim
    parameters[:N, 4:6] = program.feed_forward
    parameters[:, 6:8] = slip.gains
    parameters[:, 8:10] = slip.offset
    parameters[:, 10:12] = slip.turn_left, slip.side_slip
    parameters[:N, 12] = program.ahead
    parameters[:, 13:15] = slip.slide_x, slip.slide_y
    parameters[:N, 15:17] = np.diff(program.feed_forward, axis=0, prepend=program.fed_before[None])
    parameters[:, 17:] = program.soft_limits
    return np.concatenate([estimate.state, estimate.pose, past.ravel()]), parameters


def _body_twist(turn_left: ca.SX, point: ca.SX) -> ca.SX:
    """Compute the twist of the body's origin from the twist of its centre of rotation."""
    return ca.vertcat(point[0] + turn_left * point[1], point[1])


def _serialise(name: str, arguments: list[ca.SX], result: ca.SX) -> str:
    return str(ca.Function(name, arguments, [result]).serialize())
