"""Construction of the problem of a configuration: selection and discretisation of the model."""

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
from diffdrive_mpc.mpc.config.config_file import model_of
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.problem.constants import Problem
from diffdrive_mpc.mpc.problem.feed_forward import FeedForward
from diffdrive_mpc.mpc.problem.margin import with_increments
from diffdrive_mpc.mpc.problem.terms import Term


def chosen_model(
    config: ControllerConfig, given_model: VelocityModel | NonlinearModel | str | Path | None
) -> VelocityModel | NonlinearModel:
    """Load the prediction model: `given_model`, or the model of the configuration with its extra dead time.

    Raises
    ------
    ConfigError, ModelError
        If the model cannot be loaded.
    ArgumentError
        If `given_model` is not a model, a name or a path.
    """
    extra = config.extra_dead_time
    model: VelocityModel | NonlinearModel
    if given_model is None:
        model = load_model(model_of(config)).with_extra_dead_time([extra.v, extra.omega])
    elif isinstance(given_model, (str, Path)):
        model = load_model(given_model)
    elif isinstance(given_model, (VelocityModel, NonlinearModel)):
        model = given_model
    else:
        raise wrong_type(
            "model",
            "a velocity model, or its name or path",
            given_model,
            "convert a system of python-control with VelocityModel.from_control(system, dead_time=(0.0, 0.0))",
        )
    if config.compensation.dead_time:
        return model
    if isinstance(model, NonlinearModel):
        raise ConfigError(
            f"compensation.dead_time = false: model '{model.name}' has built-in dead time; set the key to true, "
            "or use a model without dead time"
        )
    return replace(model, dead_time=np.zeros(2))


def sampled_model(model: VelocityModel | NonlinearModel, dt: float) -> DiscreteModel | NonlinearModel:
    """Sample the model at `dt` [s]; raise ConfigError if a nonlinear model requires another sample time."""
    if isinstance(model, VelocityModel):
        return model.discretise(dt)
    if not math.isclose(model.dt, dt, rel_tol=1e-9):
        raise ConfigError(f"sample_time = {dt} s: model '{model.name}' requires {model.dt} s; set sample_time to it")
    return model


def is_from_file(model: VelocityModel | NonlinearModel) -> bool:
    """Return True if the model is from a file, and was identified on its robot; False if it was built in Python."""
    return model.provenance.get("origin", "python-control") != "python-control"


def build_problem(
    config: ControllerConfig, model: VelocityModel | NonlinearModel, terms: Sequence[Term] = ()
) -> Problem:
    """Build the problem for `model`; raise the errors of `sampled_model`, `with_increments` and `Problem`."""
    dt = config.sample_time
    sampled = sampled_model(model, dt)
    increments, feed_forward = with_increments(config, sampled), FeedForward.from_model(model, dt)
    return Problem(increments, sampled, feed_forward, tuple(terms), is_from_file(model))
