"""The nonlinear problem of a tick as CasADi functions, for IPOPT and other solvers.

They are composed of the formulas that the compiled controller runs (`mpc.problem.formulas`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.config_file import load_config
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.features.registry import feature_terms, prepared
from diffdrive_mpc.mpc.problem.build import build_problem, chosen_model
from diffdrive_mpc.mpc.problem.constants import Problem
from diffdrive_mpc.mpc.problem.formulas import arc_move, body_twist, named_function, softly_limited, tracking_errors
from diffdrive_mpc.mpc.problem.terms import Term, all_terms, checked_terms, parameter_places

_UNLIMITED = 1e13


@dataclass(frozen=True)
class CasadiProblem:
    """The problem of a tick: dynamics and cost of a stage, and the horizon of N stages.

    With n states of the velocity model, W commands on their way, S slip parameters (10, or 15 with curved slip), P
    stage parameters of terms and K kinds of soft limit, the inputs by name are:

    ==============  ==============  ====================================================================================
    plan            (2, N)          v_ref [m/s], omega_ref [rad/s] of each step
    state           (n, 1)          states of the velocity model
    pose            (3, 1)          x, y [m], theta [rad]
    slip            (S, 1)          see `mpc.problem.slip`
    sent            (2, W)          commands sent before, oldest first
    late            (2, 1)          estimated delays of v_ref and omega_ref beyond the model [samples]
    last_command    (2, 1)          command from which the first increment counts
    reference       (4, N + 1)      x, y [m], theta [rad] to aim at, and the heading [rad] to hold
    feed_forward    (2, N + 1)      commands from which deviations count; the first is that of the last tick
    ahead           (1, N)          distance of the turning point ahead of the origin on each arc [m], held constant
    parameters      (P, N + 1)      stage parameters of the terms
    ==============  ==============  ====================================================================================

    Poses follow by exact arcs with the mean of the twists at their ends (Guffanti et al., Sensors 2025, 25(11), 3553).
    A linear model is x' = A x + B0 u[k - d] + B1 u[k - d - 1], see `models.discrete_model`.

    Attributes
    ----------
    stage
        (state, pose, slip, sent (2, W + 1) with the command of the stage last, late, ahead (1, 1)) to `next_state`,
        `next_pose` and `next_twist` (2, 1) [m/s, rad/s] of the body.
    stage_cost
        (pose, twist, command, previous_command, reference (4, 1), feed_forward and previous_feed_forward (2, 1),
        parameters (P, 1), terminal) to `cost` [-], at the end of a stage; `terminal` multiplies the errors' weights.
    limited
        (pose, twist, command, reference (4, 1), slip, parameters (P, 1)) to `values` (K, 1) that have soft limits.
    horizon
        (plan and all inputs above) to `cost` without penalties, `hard` (4, N): v_ref, omega_ref and their increments,
        the first from zero, `soft` (K, N), `poses` (3, N + 1) and `twists` (2, N + 1).
    nlp
        `x`, `p`, `f`, `g` for `casadi.nlpsol`. `x` is the plan step by step, then K N excesses over upper and K N under
        lower soft limits; f includes their penalty.
    """

    stage: ca.Function
    stage_cost: ca.Function
    limited: ca.Function
    horizon: ca.Function
    nlp: dict[str, ca.SX]

    def arguments(self, inputs: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Return `p`, `lbx`, `lbg` and `ubg` of a call of the solver, and a start `x0`.

        Parameters
        ----------
        inputs
            Those of `horizon`, `lower` and `upper` (4 + K, N), as `Controller.problem_inputs` returns them.
        """
        values = [inputs[name] for name in self.horizon.name_in()[1:]]
        bounds = [np.where(np.abs(inputs[side]) < _UNLIMITED, inputs[side], np.inf) for side in ("lower", "upper")]
        lower, upper = np.copysign(bounds[0], inputs["lower"]), np.copysign(bounds[1], inputs["upper"])
        hard, soft = lower[:4].size, np.full(lower[4:].size, np.inf)
        plan, slacks = inputs["feed_forward"][:, 1:].T.ravel(), np.zeros(2 * len(soft))
        return {
            "p": np.concatenate([np.asarray(value).ravel("F") for value in values]),
            "x0": np.concatenate([plan, slacks]),
            "lbx": np.concatenate([np.full(len(plan), -np.inf), slacks]),
            "lbg": np.concatenate([lower.ravel()[:hard], -soft, lower.ravel()[hard:]]),
            "ubg": np.concatenate([upper.ravel(), soft]),
        }


def casadi_problem(
    config: ControllerConfig | str | Path | Mapping[str, object],
    model: VelocityModel | NonlinearModel | str | Path | None = None,
    terms: Sequence[Term] = (),
    **overrides: object,
) -> CasadiProblem:
    """Return the nonlinear problem of a tick; the arguments are those of `Controller`.

    `Controller.problem_inputs` returns the numbers of a tick.

    Raises
    ------
    ConfigError
        Like `Controller`; and if the configuration limits the turn radius, which depends on the direction of travel.
    """
    config = prepared(load_config(config, overrides))
    own = all_terms(config.terms, (*checked_terms(terms), *feature_terms(config)))
    problem = build_problem(config, chosen_model(config, model), own)
    for name in ("min_turn_radius", "min_commanded_radius"):
        if getattr(config.limits, name) is not None:
            raise ConfigError(f"limits.{name}: not part of the CasADi problem; remove it, or state it as a soft term")
    stage, stage_cost, limited = _stage(problem), _stage_cost(problem), _limited(problem)
    horizon = _horizon(problem, stage, stage_cost, limited)
    return CasadiProblem(stage, stage_cost, limited, horizon, _nlp(problem, horizon))


def _symbols(problem: Problem) -> dict[str, ca.SX]:
    sizes, N = problem.sizes, problem.config.horizon
    shapes = {
        "state": (sizes["states"], 1),
        "pose": (3, 1),
        "slip": (sizes["slips"], 1),
        "sent": (2, sizes["window"]),
        "late": (2, 1),
        "last_command": (2, 1),
        "reference": (4, N + 1),
        "feed_forward": (2, N + 1),
        "ahead": (1, N),
        "parameters": (sizes["parameters"], N + 1),
    }
    return {name: ca.SX.sym(name, *shape) for name, shape in shapes.items()}


def _outputs(problem: Problem, state: ca.SX) -> ca.SX:
    """Twist (2, 1) of the model."""
    model = problem.model
    return model.output(state) if isinstance(model, NonlinearModel) else model.C @ state


def _next_state(problem: Problem, state: ca.SX, sent: ca.SX, late: ca.SX) -> ca.SX:
    """State (n, 1) after a sample; `sent` (2, W + 1) ends with its command."""
    model, newest = problem.model, sent.size2() - 1
    if isinstance(model, NonlinearModel):
        return model.step(state, ca.vec(sent[:, newest - model.memory :]))
    spare = problem.sizes["spare"]

    def acting(channel: int, age: int) -> ca.SX:
        """Interpolate between the commands that are older by the estimated delay."""
        weights = [ca.fmax(0, 1 - ca.fabs(late[channel] - i)) for i in range(spare + 2)] if spare else [1]
        first = newest - age - int(model.delay[channel])
        return sum(weight * sent[channel, first - i] for i, weight in enumerate(weights))

    recent, older = (ca.vertcat(acting(0, age), acting(1, age)) for age in (0, 1))
    return model.A @ state + model.B0 @ recent + model.B1 @ older


def _stage(problem: Problem) -> ca.Function:
    symbols, dt = _symbols(problem), problem.model.dt
    inputs = {name: symbols[name] for name in ("state", "pose", "slip", "sent", "late", "ahead")}
    inputs["sent"], inputs["ahead"] = ca.SX.sym("sent", 2, problem.sizes["window"] + 1), ca.SX.sym("ahead")
    state, pose, slip, sent, late, ahead = inputs.values()
    after = _next_state(problem, state, sent, late)
    twist, next_twist = (body_twist(_outputs(problem, x), slip) for x in (state, after))
    v, omega = ca.vertsplit(0.5 * (twist + next_twist))
    moved = pose + ca.vertcat(arc_move(pose[2], v, omega, slip, ahead, ca.SX(dt)), dt * omega)
    return named_function("stage", inputs, {"next_state": after, "next_pose": moved, "next_twist": next_twist})


def _values(terms: Sequence[Term], inputs: Mapping[str, ca.SX], *, soft: bool) -> list[ca.SX]:
    """Values of the terms of one kind."""
    places = parameter_places(terms)
    return [
        term.function(
            *({**inputs, "parameters": inputs["parameters"][places[term.name]]}[n] for n in term.function.name_in())
        )
        for term in terms
        if term.soft == soft
    ]


def _stage_cost(problem: Problem) -> ca.Function:
    w, lengths = problem.config.weights, {"pose": 3, "twist": 2, "command": 2, "previous_command": 2, "reference": 4}
    lengths |= {"feed_forward": 2, "previous_feed_forward": 2, "parameters": problem.sizes["parameters"], "terminal": 1}
    inputs = {name: ca.SX.sym(name, length) for name, length in lengths.items()}
    errors = tracking_errors(inputs["pose"], inputs["reference"])
    deviation = inputs["command"] - inputs["feed_forward"]
    increment = deviation - (inputs["previous_command"] - inputs["previous_feed_forward"])
    squares = inputs["terminal"] * ca.dot(ca.DM([w.along, w.across, w.heading]), errors**2)
    squares += ca.dot(ca.DM([w.v, w.omega]), deviation**2)
    squares += ca.dot(ca.DM(np.array([w.v_increment, w.omega_increment], dtype=float)), increment**2)
    squares += sum(ca.sumsqr(value) for value in _values(problem.terms, inputs, soft=False))
    return named_function("stage_cost", inputs, {"cost": 0.5 * squares})


def _limited(problem: Problem) -> ca.Function:
    sizes = problem.sizes
    lengths = {"pose": 3, "twist": 2, "command": 2, "reference": 4, "slip": sizes["slips"]}
    inputs = {name: ca.SX.sym(name, size) for name, size in (lengths | {"parameters": sizes["parameters"]}).items()}
    half_track = ca.vertcat(inputs["slip"], 0.5 * problem.config.wheels.track)
    shipped = softly_limited(inputs["pose"], inputs["twist"], inputs["reference"], half_track)
    return named_function(
        "limited", inputs, {"values": ca.vertcat(shipped, *_values(problem.terms, inputs, soft=True))}
    )


def _horizon(problem: Problem, stage: ca.Function, cost: ca.Function, limited: ca.Function) -> ca.Function:
    N, p = problem.config.horizon, _symbols(problem)
    plan = ca.SX.sym("plan", 2, N)
    window, before = p["sent"].size2(), ca.horzcat(p["last_command"], plan[:, :-1])
    line, state, total = ca.horzcat(p["sent"], plan), p["state"], ca.SX(0)
    poses, twists = [p["pose"]], [body_twist(_outputs(problem, state), p["slip"])]
    soft: list[Any] = []
    for k in range(N):
        state, pose, twist = stage(state, poses[-1], p["slip"], line[:, k : k + window + 1], p["late"], p["ahead"][k])
        fed, parameters, aim = p["feed_forward"], p["parameters"][:, k + 1], p["reference"][:, k + 1]
        terminal = problem.config.weights.terminal if k == N - 1 else 1.0
        total += cost(pose, twist, plan[:, k], before[:, k], aim, fed[:, k + 1], fed[:, k], parameters, terminal)
        soft.append(limited(pose, twist, plan[:, k], aim, p["slip"], parameters))
        poses.append(pose)
        twists.append(twist)
    hard = ca.vertcat(plan, plan - ca.horzcat(ca.SX(2, 1), plan[:, :-1]))
    outputs = {"cost": total, "hard": hard, "soft": ca.horzcat(*soft)}
    outputs |= {"poses": ca.horzcat(*poses), "twists": ca.horzcat(*twists)}
    return named_function("horizon", {"plan": plan, **p}, outputs)


def _nlp(problem: Problem, horizon: ca.Function) -> dict[str, ca.SX]:
    N, p, w = problem.config.horizon, _symbols(problem), problem.config.weights
    plan = ca.SX.sym("plan", 2, N)
    cost, hard, soft, *_ = horizon(plan, *p.values())
    over, under = (ca.SX.sym(side, soft.numel()) for side in ("over", "under"))
    slacks, values = ca.vertcat(over, under), ca.vec(soft.T)
    penalty = w.soft * ca.sum1(slacks) + 0.5 * w.soft_quadratic * ca.sumsqr(slacks)
    rows = ca.vertcat(ca.vec(hard.T), values - over, values + under)
    return {"x": ca.veccat(plan, slacks), "p": ca.veccat(*p.values()), "f": cost + penalty, "g": rows}
