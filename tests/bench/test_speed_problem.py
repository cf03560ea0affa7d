"""Peers solve the controller's own problem: stage by stage it has the same predictions, cost, limits and solution."""

from types import SimpleNamespace

import numpy as np
from speed_parts import oracle_tick

from diffdrive_mpc.bench.studies.speed.stage import stage_data, stage_problem
from diffdrive_mpc.models import load_model
from diffdrive_mpc.mpc import Controller, load_config, load_trajectory
from diffdrive_mpc.sim import make_plant
from oracle.problem import TrackingProblem

SOFT = {
    "none": {},
    "twist": {"limits.predicted_v": 0.46, "limits.predicted_omega": 0.45},
    "wheels": {"limits.wheel_speed": 0.55},
    "corridor": {"limits.corridor": 0.031},
}
KINDS = {"none": [], "twist": [0, 1], "wheels": [2, 3], "corridor": [4]}


def setting(name, horizon, soft="none", seed=0):
    """A tick of a real drive: what the controller did at it, the oracle's problem, and the same for peers."""
    # On its way back the robot would track something gentler than its reference.
    config = load_config("ssm", {"horizon": horizon, "reentry.enabled": False} | SOFT[soft])
    model = load_model(name).with_extra_dead_time((0.011, 0.033))
    sampled, controller = model.discretise(config.sample_time), Controller(config, model)
    plant, reference = make_plant("model:ssm", seed=seed), load_trajectory("circle")
    # Heading outwards where the corridor is to matter, and while it still does.
    turned, ticks = (-0.6, 24) if soft == "corridor" else (0.0, 60 + seed % 40)
    plant.reset(reference.sample([0.0]).pose[0] + [0.0, 0.0, turned])
    controller.start(reference, plant.time)
    sent = [np.zeros(2)] * sampled.memory
    for _ in range(ticks):
        result = controller.step(plant.time, plant.measure())
        plant.advance(result.command)
        sent.append(result.command)
    # Without the command that the last tick decided.
    past = np.array(sent[-1 - sampled.memory : -1])
    return SimpleNamespace(
        controller=controller,
        result=result,
        past=past,
        problem=TrackingProblem(config, sampled),
        tick=oracle_tick(controller.program, result.estimate, past),
        stages=stage_problem(config, sampled),
        data=stage_data(controller.program, result.estimate, past),
    )
