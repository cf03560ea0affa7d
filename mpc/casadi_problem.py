"""Nonlinear problem of a tick as CasADi functions, for IPOPT and other solvers.

The functions use the same formulas as the compiled controller (`mpc.problem.formulas`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import casadi as ca
import numpy as np

from diffdrive_mpc.models.errors import checked_call, checked_methods
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.config_file import load_config
from diffdrive_mpc.mpc.config.schema import ControllerConfig, Weights
from diffdrive_mpc.mpc.features.registry import feature_terms, prepare_config
from diffdrive_mpc.mpc.problem.build import build_problem, chosen_model
from diffdrive_mpc.mpc.problem.constants import Problem
from diffdrive_mpc.mpc.problem.formulas import (
    arc_move,
    body_twist,
    named_function,
    radius_violation,
    soft_limit_values,
    term_symbols,
    tracking_errors,
)
from diffdrive_mpc.mpc.problem.terms import Term, all_terms, checked_terms, parameter_places

# Bounds above this value count as none; it is below `terms._NO_LIMIT`, which solvers would treat as a bound.
_UNLIMITED = 1e13


@checked_methods
@dataclass(frozen=True)
class CasadiProblem:
    """Nonlinear problem of a tick: dynamics and cost of a stage, and the problem over a horizon of N stages.

    The sizes are: n states of the velocity model, W pending commands, S slip parameters (10, or 15 with curved slip), P
    stage parameters of terms, and K kinds of soft limit. The inputs are:

    ==============  ==============  ====================================================================================
    plan            (2, N)          v_ref [m/s], omega_ref [rad/s] of each step
    state           (n, 1)          states of the velocity model
    pose            (3, 1)          x, y [m], theta [rad] at the start of the horizon
    slip            (S, 1)          see `mpc.problem.slip`
    sent            (2, W)          pending commands, oldest first
    late            (2, 1)          estimated delays of v_ref and omega_ref beyond the model [samples]
    last_command    (2, 1)          command before the first increment
    reference       (4, N + 1)      x, y [m], theta [rad] of the reference poses, and the target heading [rad]
    feed_forward    (2, N + 1)      commands whose deviations are penalised; the first column is for the last tick
    ahead           (1, N)          distance of the turning point ahead of the origin on each arc [m]
    direction       (2, N)          direction of the reference, 1 or -1, at the end of a step and one lag later
    parameters      (P, N + 1)      stage parameters of the terms
    ==============  ==============  ====================================================================================

    Poses follow from exact arcs with the mean of the twists at their ends (Guffanti et al., Sensors 2025, 25(11),
    3553).
    A linear model is x' = A x + B0 u[k - d] + B1 u[k - d - 1], see `models.discrete_model`.

    Attributes
    ----------
    stage
        Dynamics: (state, pose, slip, sent (2, W + 1), late, ahead (1, 1)) to `next_state`, `next_pose` and `next_twist`
        (2, 1) [m/s, rad/s] of the body. The last column of `sent` is the command of the stage.
    stage_cost
        Cost at the end of a stage: (pose, twist, command, reference (4, 1), parameters (P, 1), previous_command,
        feed_forward and previous_feed_forward (2, 1), terminal) to `cost` [-]. `terminal` is a factor of the weights of
        the tracking errors.
    limited
        Soft-limited values: (pose, twist, command, reference (4, 1), parameters (P, 1), slip, direction (2, 1)) to
        `values` (K, 1).
    horizon
        All stages: (all inputs of the table) to `cost` without penalties, `hard` (4, N), `soft` (K, N), `poses`
        (3, N + 1) and `twists` (2, N + 1). The rows of `hard` are v_ref, omega_ref and their increments, the first
        increment relative to zero.
    nlp
        `x`, `p`, `f`, `g` for `casadi.nlpsol`. `x` contains the plan step by step, K N violations of upper soft limits,
        and K N violations of lower soft limits. `f` includes the penalty of the violations.
    """

    stage: ca.Function
    stage_cost: ca.Function
    limited: ca.Function
    horizon: ca.Function
    nlp: dict[str, ca.SX] = field(repr=False)

    def arguments(self, inputs: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Return the arguments of a solver call: `p`, `lbx`, `lbg`, `ubg`, and the initial guess `x0`.

        Raises ValueError if an input is missing.

        Parameters
        ----------
        inputs
            Inputs of `horizon`, and the bounds `lower` and `upper` (4 + K, N), from `Controller.problem_inputs`.
        """
        names = self.horizon.name_in()[1:]
        if missing := [name for name in (*names, "lower", "upper") if name not in inputs]:
            raise ValueError(f"inputs: {', '.join(missing)} missing; give those of Controller.problem_inputs()")
        values = [inputs[name] for name in names]
        for name, value in zip(names, values, strict=True):
            if np.size(value) != (size := self.horizon.numel_in(name)):
                raise ValueError(
                    f"inputs: {name} has {np.size(value)} values, expected {size}; give those of a controller with the "
                    "same model, horizon and limits"
                )
        bounds = [np.where(np.abs(inputs[side]) < _UNLIMITED, inputs[side], np.inf) for side in ("lower", "upper")]
        lower, upper = np.copysign(bounds[0], inputs["lower"]), np.copysign(bounds[1], inputs["upper"])
        # The first four kinds of limit are hard. A soft limit takes two rows, one for each of its sides and slacks.
        hard, soft = lower[:4].size, np.full(lower[4:].size, np.inf)
        plan, slacks = inputs["feed_forward"][:, 1:].T.ravel(), np.zeros(2 * len(soft))
        return {
            "p": np.concatenate([np.asarray(value).ravel("F") for value in values]),
            "x0": np.concatenate([plan, slacks]),
            "lbx": np.concatenate([np.full(len(plan), -np.inf), slacks]),
            "lbg": np.concatenate([lower.ravel()[:hard], -soft, lower.ravel()[hard:]]),
            "ubg": np.concatenate([upper.ravel(), soft]),
        }


@checked_call()
def casadi_problem(
    config: ControllerConfig | str | Path | Mapping[str, object],
    model: VelocityModel | NonlinearModel | str | Path | None = None,
    terms: Sequence[Term] = (),
    **overrides: object,
) -> CasadiProblem:
    """Build the nonlinear problem of a tick from the arguments of `Controller`.

    `Controller.problem_inputs` returns the input values of a tick. For a network model, give IPOPT
    `{"ipopt.hessian_approximation": "limited-memory"}`, since the exact Hessian takes minutes to form.

    Raises
    ------
    ConfigError
        If the configuration or a term is invalid, as for `Controller`.
    """
    config = prepare_config(load_config(config, overrides))
    terms = all_terms(config.terms, (*checked_terms(terms), *feature_terms(config)))
    problem = build_problem(config, chosen_model(config, model), terms)
    symbols = _create_symbols(problem)
    stage, stage_cost, limited = _stage(problem, symbols), _stage_cost(problem), _soft_values(problem)
    outputs = _roll_out(problem, symbols, stage, stage_cost, limited)
    horizon = named_function("horizon", symbols, outputs)
    return CasadiProblem(stage, stage_cost, limited, horizon, _nlp(config.weights, symbols, outputs))


def _create_symbols(problem: Problem) -> dict[str, ca.SX]:
    sizes, N = problem.sizes, problem.config.horizon
    shapes = {
        "plan": (2, N),
        "state": (sizes["states"], 1),
        "pose": (3, 1),
        "slip": (sizes["slips"], 1),
        "sent": (2, sizes["window"]),
        "late": (2, 1),
        "last_command": (2, 1),
        "reference": (4, N + 1),
        "feed_forward": (2, N + 1),
        "ahead": (1, N),
        "direction": (2, N),
        "parameters": (sizes["parameters"], N + 1),
    }
    return {name: ca.SX.sym(name, *shape) for name, shape in shapes.items()}


def _model_twist(problem: Problem, state: ca.SX) -> ca.SX:
    """Return the twist (2, 1) of the model in `state`."""
    model = problem.model
    return ca.SX(model.output(state) if isinstance(model, NonlinearModel) else model.C @ state)


def _next_state(problem: Problem, state: ca.SX, sent: ca.SX, late: ca.SX) -> ca.SX:
    """Return the state (n, 1) one sample later; the last column of `sent` (2, W + 1) is the current command."""
    model, newest = problem.model, sent.size2() - 1
    if isinstance(model, NonlinearModel):
        return model.step(state, ca.vec(sent[:, newest - model.memory :]))
    ages = range(problem.sizes["spare"] + 1 + (problem.sizes["spare"] > 0))

    def delayed_command(channel: int, lag: int) -> ca.SX:
        """Interpolate the command that takes effect after the estimated delay."""
        first = newest - lag - int(model.delay[channel])
        # The delay is a symbol and cannot be an index, so the commands of all ages are summed with the weights of a
        # linear interpolation.
        return ca.SX(sum(ca.fmax(0, 1 - ca.fabs(late[channel] - age)) * sent[channel, first - age] for age in ages))

    recent, older = (ca.vertcat(delayed_command(0, lag), delayed_command(1, lag)) for lag in (0, 1))
    return ca.SX(model.A @ state + model.B0 @ recent + model.B1 @ older)


def _stage(problem: Problem, symbols: Mapping[str, ca.SX]) -> ca.Function:
    inputs, dt = {name: symbols[name] for name in ("state", "pose", "slip", "sent", "late", "ahead")}, problem.model.dt
    inputs["sent"], inputs["ahead"] = ca.SX.sym("sent", 2, problem.sizes["window"] + 1), ca.SX.sym("ahead")
    state, pose, slip, sent, late, ahead = inputs.values()
    next_state = _next_state(problem, state, sent, late)
    twist, next_twist = (body_twist(_model_twist(problem, x), slip) for x in (state, next_state))
    v, omega = ca.vertsplit(0.5 * (twist + next_twist))
    next_pose = pose + ca.vertcat(arc_move(pose[2], v, omega, slip, ahead, ca.SX(dt)), dt * omega)
    return named_function("stage", inputs, {"next_state": next_state, "next_pose": next_pose, "next_twist": next_twist})


def _values(terms: Sequence[Term], inputs: Mapping[str, ca.SX], *, soft: bool) -> list[ca.SX]:
    """Return the values of the soft limits if `soft`, otherwise those of the cost terms."""
    values, places = [], parameter_places(terms)
    for term in terms:
        arguments = {**inputs, "parameters": inputs["parameters"][places[term.name]]}
        if term.soft == soft:
            values.append(term.function(*(arguments[name] for name in term.function.name_in())))
    return values


def _stage_cost(problem: Problem) -> ca.Function:
    w, inputs = problem.config.weights, term_symbols(problem.sizes["parameters"])
    inputs |= {name: ca.SX.sym(name, 2) for name in ("previous_command", "feed_forward", "previous_feed_forward")}
    inputs["terminal"] = ca.SX.sym("terminal")
    errors = tracking_errors(inputs["pose"], inputs["reference"])
    deviation = inputs["command"] - inputs["feed_forward"]
    increment = deviation - (inputs["previous_command"] - inputs["previous_feed_forward"])
    squares = inputs["terminal"] * ca.dot(ca.DM([w.along, w.across, w.heading]), errors**2)
    squares += ca.dot(ca.DM([w.v, w.omega]), deviation**2)
    squares += ca.dot(ca.DM(np.array([w.v_increment, w.omega_increment], dtype=float)), increment**2)
    squares += sum(ca.sumsqr(value) for value in _values(problem.terms, inputs, soft=False))
    return named_function("stage_cost", inputs, {"cost": 0.5 * squares})


def _soft_values(problem: Problem) -> ca.Function:
    inputs, limits = term_symbols(problem.sizes["parameters"]), problem.config.limits
    inputs |= {"slip": ca.SX.sym("slip", problem.sizes["slips"]), "direction": ca.SX.sym("direction", 2)}
    half_track = ca.vertcat(inputs["slip"], 0.5 * problem.config.wheels.track)
    built_in = soft_limit_values(inputs["pose"], inputs["twist"], inputs["reference"], half_track)
    turns = [
        radius_violation(inputs[moves], ca.vertcat(radius, inputs["direction"][row]))
        for row, (moves, radius) in enumerate(
            (("twist", limits.min_turn_radius), ("command", limits.min_commanded_radius))
        )
        if radius is not None
    ]
    values = ca.vertcat(built_in, *turns, *_values(problem.terms, inputs, soft=True))
    return named_function("limited", inputs, {"values": values})


def _roll_out(
    problem: Problem, p: Mapping[str, ca.SX], stage: ca.Function, cost: ca.Function, limited: ca.Function
) -> dict[str, ca.SX]:
    plan, feed_forward, slip, window = p["plan"], p["feed_forward"], p["slip"], p["sent"].size2()
    commands, previous = ca.horzcat(p["sent"], plan), ca.horzcat(p["last_command"], plan[:, :-1])
    state, total, poses, soft = p["state"], ca.SX(0), [p["pose"]], []
    twists = [body_twist(_model_twist(problem, state), slip)]
    for k in range(problem.config.horizon):
        state, pose, twist = stage(state, poses[-1], slip, commands[:, k : k + window + 1], p["late"], p["ahead"][k])
        at_end = pose, twist, plan[:, k], p["reference"][:, k + 1], p["parameters"][:, k + 1]
        terminal = problem.config.weights.terminal if k == problem.config.horizon - 1 else 1.0
        total += cost(*at_end, previous[:, k], feed_forward[:, k + 1], feed_forward[:, k], terminal)
        soft.append(limited(*at_end, slip, p["direction"][:, k]))
        poses.append(pose)
        twists.append(twist)
    hard = ca.vertcat(plan, plan - ca.horzcat(ca.SX(2, 1), plan[:, :-1]))
    rows = {"soft": ca.horzcat(*soft), "poses": ca.horzcat(*poses), "twists": ca.horzcat(*twists)}
    return {"cost": total, "hard": hard, **rows}


def _nlp(w: Weights, symbols: Mapping[str, ca.SX], outputs: Mapping[str, ca.SX]) -> dict[str, ca.SX]:
    plan, *inputs = symbols.values()
    values = ca.vec(outputs["soft"].T)
    over, under = (ca.SX.sym(side, values.numel()) for side in ("over", "under"))
    slacks, rows = ca.vertcat(over, under), ca.vertcat(ca.vec(outputs["hard"].T), values - over, values + under)
    penalty = w.soft * ca.sum1(slacks) + 0.5 * w.soft_quadratic * ca.sumsqr(slacks)
    return {"x": ca.veccat(plan, slacks), "p": ca.veccat(*inputs), "f": outputs["cost"] + penalty, "g": rows}
