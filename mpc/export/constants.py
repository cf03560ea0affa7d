"""The generated C of one controller: ddmpc_sizes.h and constants.c."""

from __future__ import annotations

import numpy as np
from diffdrive_mpc.mpc.compiled.constants import (
    estimation_constants,
    estimator_sizes,
    initialiser,
    sizes_header,
    tracking_constants,
    tracking_sizes,
)

from diffdrive_mpc.mpc.export.osqp_workspaces import QpShape, slack_scale
from diffdrive_mpc.mpc.export.parts import Parts

# What exceeds a soft limit by less is the size of the solver's residuals in each precision.
_SOFT_SLACK = {False: 1e-6, True: 1e-4}


def sizes_text(parts: Parts, slots: int, *, single: bool) -> str:
    """Text of ddmpc_sizes.h; `slots` soft limits may matter at one tick."""
    sizes = {
        **tracking_sizes(parts.sampled, parts.config.horizon, parts.feed_forward),
        **estimator_sizes(parts.sampled, parts.history),
        "DDMPC_SLOTS": slots,
        "DDMPC_ITERATION_LIMIT": parts.config.solver.max_iterations,
    }
    text = sizes_header(sizes)
    return text.replace("\n#define", "\n#define DDMPC_FLOAT\n#define", 1) if single else text


def constants_text(parts: Parts, shape: QpShape, *, single: bool) -> str:
    """Text of constants.c."""
    config, f = parts.config, parts.config.failure
    settings = {
        "max_pose_age": f.max_pose_age,
        "max_position_error": f.max_position_error,
        "finish_position": config.finish.position,
        "finish_speed": config.finish.speed,
        "finish_timeout": config.finish.timeout,
        "max_reused_ticks": f.max_reused_ticks,
        "resume": f.resume,
        "soft_linear": config.weights.soft,
        "soft_quadratic": config.weights.soft_quadratic,
        "soft_slack": _SOFT_SLACK[single],
        "row_scale": shape.hard_scale(),
        "soft_scale": shape.soft_scale(config.weights.soft_quadratic),
        "slack_scale": slack_scale(config.weights.soft_quadratic),
    }
    # Instants stay double in every precision.
    dt = parts.sampled.dt
    times = f"    .sample_time = {dt!r},\n    .longest_pause = {parts.history * dt!r},\n"
    arrays = {name: np.array(value, dtype=float) for name, value in settings.items()}
    filter_constants = estimation_constants(parts.sampled, config.estimator, parts.slip_filter)
    values = {
        "ddmpc_estimation ddmpc_this_estimation": initialiser(filter_constants),
        "ddmpc_tracking ddmpc_this_tracking": initialiser(tracking_constants(parts.problem, parts.feed_forward)),
        "ddmpc_settings ddmpc_this_settings": initialiser(arrays).replace("{\n", "{\n" + times, 1),
    }
    definitions = [f"const {name} = {value};" for name, value in values.items()]
    return "\n\n".join(['#include "constants.h"', *definitions, ""])
