"""From a configuration to the problem that it poses: which model, sampled how."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.errors import wrong_type
from diffdrive_mpc.models.load import load_model
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.problem.constants import Problem
from diffdrive_mpc.mpc.problem.feed_forward import FeedForward
from diffdrive_mpc.mpc.problem.terms import Term


def chosen_model(
    config: ControllerConfig, stated: VelocityModel | NonlinearModel | str | Path | None
) -> VelocityModel | NonlinearModel:
    """The model to predict with, extra dead time included where it is the configuration's.

    Raises
    ------
    ConfigError, ModelError
        If the model cannot be loaded.
    ArgumentError
        If it is no model.
    """
    extra = config.extra_dead_time
    model: VelocityModel | NonlinearModel
    if stated is None:
        model = load_model(config.model).with_extra_dead_time([extra.v, extra.omega])
    elif isinstance(stated, (str, Path)):
        model = load_model(stated)
    elif isinstance(stated, (VelocityModel, NonlinearModel)):
        model = stated
    else:
        raise wrong_type(
            "model",
            "a velocity model, or its name or path",
            stated,
            "a system of python-control becomes one with VelocityModel.from_control(system, dead_time=(0.0, 0.0))",
        )
    if config.compensation.dead_time:
        return model
    if isinstance(model, NonlinearModel):
        raise ConfigError(
            f"compensation.dead_time = false: model '{model.name}' has its dead time in its window; set it to true, or "
            "give a model without"
        )
    return replace(model, dead_time=np.zeros(2))


def sampled_model(model: VelocityModel | NonlinearModel, dt: float) -> DiscreteModel | NonlinearModel:
    """The model at samples `dt` [s] apart; raises ConfigError if it is for others."""
    if isinstance(model, VelocityModel):
        return model.discretise(dt)
    if not math.isclose(model.dt, dt, rel_tol=1e-9):
        raise ConfigError(f"sample_time = {dt} s: model '{model.name}' is for {model.dt} s; set sample_time to that")
    return model


def build_problem(
    config: ControllerConfig, model: VelocityModel | NonlinearModel, terms: Sequence[Term] = ()
) -> Problem:
    """The problem of a controller with `model`; raises as `sampled_model` and `Problem`."""
    dt = config.sample_time
    return Problem(config, sampled_model(model, dt), FeedForward.of(model, dt), tuple(terms))
