"""Parameters of the laboratory: flat arrays for C, in the order of structs that are generated from the same names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import load_reference
from diffdrive_mpc.bench.peers.tracking_peer import MODEL, slew_step
from diffdrive_mpc.core_sources import GeneratedC, build_problem, chosen_model, constant_fields, generate, load_core
from diffdrive_mpc.models.checked_yaml import ConfigError, read_yaml
from diffdrive_mpc.models.interface import FloatArray, Measurement, Stamped
from diffdrive_mpc.models.load import load_linear_model
from diffdrive_mpc.models.pose import arc_displacement
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.mpc import ControllerConfig, load_config
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.trajectories.arcs import ArcTrajectory
from diffdrive_mpc.mpc.trajectories.limits import load_settings
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory
from diffdrive_mpc.sim import make_plant
from diffdrive_mpc.sim.plants.surface import BodySlip, load_surface
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from diffdrive_mpc_extras.peers.rpp import load_parameters

FLOOR = ("longitudinal_gain", "yaw_gain", "wheel_yaw_gain", "side_slip")
"""Fields of `BodySlip` that a surface of the laboratory has, in the order of the second argument of `lab_f_floor`."""


def generate_plant() -> GeneratedC:
    """Generate the C code of the functions `lab_f_floor` and `lab_f_move`."""
    return generate(plant_functions(), "lab_plant", "diffdrive_mpc_lab/numbers.py")


def plant_functions() -> tuple[ca.Function, ca.Function]:
    """Build `lab_f_floor`, which applies the slip of a surface, and `lab_f_move`, which integrates a pose."""
    return _floor(), _move()


def _floor() -> ca.Function:
    """Map twist of the model (2) and parameters of the surface (4) to twist of the body (3) and of the wheels (2)."""
    output, floor = ca.SX.sym("output", 2), ca.SX.sym("floor", len(FLOOR))
    symbols: dict[str, Any] = dict(zip(FLOOR, ca.vertsplit(floor), strict=True))
    slip = BodySlip.model_construct(**symbols)
    v, omega = slip.gained(output[0], output[1])
    body = ca.vertcat(v, slip.sideways(v, omega), omega)
    return ca.Function(
        "lab_f_floor",
        [output, floor],
        [body, ca.vertcat(*slip.turned(output[0], output[1]))],
        ["output", "floor"],
        ["body", "wheels"],
    )


def _move() -> ca.Function:
    """Map pose (3), twist of the body (3) and duration (1) to the pose at the end (3)."""
    pose, body, duration = ca.SX.sym("pose", 3), ca.SX.sym("body", 3), ca.SX.sym("duration")
    after = pose + arc_displacement(pose[2], body[0], body[2], duration, body[1])
    return ca.Function("lab_f_move", [pose, body, duration], [after], ["pose", "body", "duration"], ["after"])


Struct = dict[str, FloatArray]
"""Values of a C struct by field name, in the order of the fields."""


@cache
def lab_settings() -> dict[str, Any]:
    """Load the choices of the page, `settings.yaml`."""
    settings: dict[str, Any] = read_yaml(Path(__file__).with_name("settings.yaml"))
    return settings


def values_of(name: str) -> list[Any]:
    """Return the values of a choice."""
    return list(lab_settings()["choices"][name]["values"])


def default_of(name: str) -> Any:  # noqa: ANN401 - a name or a number
    """Return the default of a choice."""
    return lab_settings()["choices"][name]["default"]


def powers() -> dict[str, float]:
    """Return the continuous choices, with the power of the value to which the constants are proportional."""
    return {name: choice["power"] for name, choice in lab_settings()["choices"].items() if "power" in choice}


# Structs.


def robot() -> Struct:
    """Return `lab_robot`: sample time [s] and command limits [m/s, rad/s]."""
    parameters = load_robot()
    return _struct(sample_time=parameters.sample_time, limits=[parameters.limits.v, parameters.limits.omega])


def floor(surface: str) -> Struct:
    """Return `lab_floor`; raises ConfigError for a surface with a slip law of the papers, which the C code lacks."""
    slip = load_surface(surface).slip
    if slip.polynomial is not None or slip.virtual_track is not None:
        raise ConfigError(
            f"surface '{surface}': the laboratory supports only gains and side slip; choose another surface"
        )
    return _struct(**{name: getattr(slip, name) for name in FLOOR})


def sensors(name: str) -> Struct:
    """Return `lab_sensors`; covariances are those of the plant's measurements, zero if there are none."""
    parameters, wheels = load_sensor_set(name), WheelKinematics(load_robot().wheel_radius, load_robot().track)
    pose, gyro = parameters.pose, parameters.gyro
    first = _first_measurement(name)

    def covariance_of(stamped: Stamped | None, size: int) -> FloatArray:
        covariance = None if stamped is None else stamped.covariance
        return np.zeros(size * size) if covariance is None else np.ravel(covariance)

    return _struct(
        period=pose.period or load_robot().sample_time,
        latency=pose.latency,
        loss=pose.loss,
        stamped_on_arrival=pose.stamped_on_arrival,
        pose_sd=[pose.position_sd, pose.position_sd, pose.heading_sd],
        gyro_sd=gyro.noise_sd,
        gyro_bias_sd=gyro.bias_sd,
        encoder_sd=parameters.encoders.speed_sd,
        body_to_wheels=wheels.body_to_wheels,
        wheels_to_body=wheels.wheels_to_body,
        pose_covariance=covariance_of(first.pose, 3),
        twist_covariance=covariance_of(first.wheel_twist, 2),
        gyro_covariance=covariance_of(first.yaw_rate, 1),
    )


def _first_measurement(sensor_set: str) -> Measurement:
    """Return the first measurement with a pose, of a robot at rest."""
    plant = make_plant("model:ssm", sensors=sensor_set)
    while (measurement := plant.measure()).pose is None:
        plant.advance(np.zeros(2))
    return measurement


def peer() -> Struct:
    """Return `lab_rpp`: parameters of regulated pure pursuit, and its limits in the benchmark."""
    config = load_config(MODEL)
    step = slew_step(config.limits, config.sample_time)
    return _struct(
        **load_parameters().model_dump(),
        max_v=config.limits.v,
        max_omega=config.limits.omega,
        step_v=step[0],
        step_omega=step[1],
    )


def drawing() -> Struct:
    """Return `lab_drawing`: settings for the conversion of a drawn line to a path with speeds."""
    shape, limits = lab_settings()["drawing"], load_robot()
    return _struct(
        spacing=shape["spacing"],
        rounds=shape["rounds"],
        acceleration=limits.reference_acceleration.v,
        lateral=limits.reference_acceleration.lateral,
        yaw_rate=load_settings().reach_share * limits.limits.omega,
    )


def _struct(**values: Any) -> Struct:  # noqa: ANN401 - a number or an array
    return {name: np.ravel(np.asarray(value, dtype=float)) for name, value in values.items()}


def flat(struct: Struct) -> FloatArray:
    """Flatten a struct to its values in memory order."""
    return np.concatenate(list(struct.values()))


# Arrays that C code points into.


def plant_model(name: str, dead_time: float) -> FloatArray:
    """Return the velocity model `name` with additional dead time [s], for `lab_set_model`."""
    model = load_linear_model(name).with_extra_dead_time([dead_time, dead_time])
    sampled = model.discretise(load_robot().sample_time)
    matrices = (np.ravel(matrix) for matrix in (sampled.A, sampled.B0, sampled.B1, sampled.C))
    return np.concatenate([[sampled.order, *sampled.delay], *matrices])


def noise(seed: int) -> FloatArray:
    """Draw the noise of `sim.sensing.sensors.Sensors` for `seed`, for `lab_set_noise`."""
    rows = lab_settings()["noise_rows"]
    pose, gyro, encoders, losses = map(np.random.default_rng, np.random.SeedSequence(seed).spawn(4))
    samples = [pose.standard_normal((rows, 3)), gyro.standard_normal(rows), encoders.standard_normal((rows, 4))]
    return np.concatenate([[rows], *map(np.ravel, samples), losses.random(rows)])


def reference(path: str, speed: float) -> FloatArray | None:
    """Return a shipped path for `lab_set_reference`, at its stated speed if `speed` is 0; None if it is too fast."""
    try:
        trajectory = load_reference(Case(trajectory=path, top_speed=speed or None))
    except ConfigError:
        return None
    if not isinstance(trajectory, (ArcTrajectory, SplineTrajectory)):
        raise ConfigError(f"path '{path}': the laboratory supports only arcs and splines")
    native = trajectory.native
    head = [float(len(native.table) == 16), native.table.shape[1], len(native.breaks), trajectory.duration]
    return np.concatenate([head, native.breaks, native.table.ravel()])


# The controller's constants.


def configuration(model: str, choices: Mapping[str, Any]) -> ControllerConfig:
    """Build the configuration of the page's controller from that of `model` and `choices`, without re-entry.

    Increment weights are set explicitly, because their defaults depend on other values. Delay compensation is off,
    because the page shows the effect of an unknown delay.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a value is out of range.
    """
    overrides: dict[str, object] = {
        "reentry.enabled": False,
        "compensation.delay": False,
        "weights.v_increment": 5.0,
        "weights.omega_increment": float(default_of("smooth")),
    }
    for name, value in choices.items():
        key = lab_settings()["choices"][name]["key"]
        keys = [f"{key}.v", f"{key}.omega"] if name == "told" else [key]
        overrides |= dict.fromkeys(keys, value if name == "horizon" else float(value))
    return replace_values(load_config(model), overrides)


class Constants(NamedTuple):
    """Sizes and constants of a controller, field by field as `lab_read_controller` reads them."""

    sizes: FloatArray
    fields: dict[str, FloatArray]


def controller(config: ControllerConfig) -> Constants:
    """Return `ddmpc_sizes` and `ddmpc_constants` for a configuration; each array is preceded by its length."""
    problem = build_problem(config, chosen_model(config, None), ())
    fields = {}
    for name, value in constant_fields(problem.sizes, problem.constants()):
        numbers = np.ravel(np.asarray(value, dtype=float))
        fields[name] = np.concatenate([[numbers.size], numbers]) if isinstance(value, np.ndarray) else numbers
    return Constants(np.array(list(problem.sizes.values()), dtype=float), fields)


def structs() -> dict[str, Struct]:
    """Return all generated structs by their name in C, with example values."""
    return {
        "lab_robot": robot(),
        "lab_floor": floor("default"),
        "lab_sensors": sensors("default"),
        "lab_rpp": peer(),
        "lab_drawing": drawing(),
    }


_HEADER = """\
/* Generated from diffdrive_mpc_lab/numbers.py; do not edit. */
#ifndef LAB_NUMBERS_H
#define LAB_NUMBERS_H

#include "core.h"

{structs}
void lab_read_controller(const double *at, ddmpc_sizes *sizes, ddmpc_constants *constants);

#endif
"""
_SOURCE = """\
/* Generated from diffdrive_mpc_lab/numbers.py; do not edit. */
#include "lab_numbers.h"

void lab_read_controller(const double *at, ddmpc_sizes *sizes, ddmpc_constants *constants)
{{
{lines}
}}
"""


def generated_texts() -> dict[str, str]:
    """Generate lab_numbers.h and lab_numbers.c."""
    declared = "\n".join(
        f"typedef struct {{\n{''.join(_member(*item) for item in struct.items())}}} {name};\n"
        for name, struct in structs().items()
    )
    return {
        "lab_numbers.h": _HEADER.format(structs=declared),
        "lab_numbers.c": _SOURCE.format(lines="\n".join(f"    {line}" for line in _readers())),
    }


def _member(name: str, numbers: FloatArray) -> str:
    return f"    double {name}{f'[{numbers.size}]' if numbers.size > 1 else ''};\n"


def _readers() -> Iterator[str]:
    ffi, _ = load_core()
    for name, _ in ffi.typeof("ddmpc_sizes").fields:
        yield f"sizes->{name} = (int)*at++;"
    for name, field in ffi.typeof("ddmpc_constants").fields:
        if field.type.kind == "pointer":
            yield f"constants->{name} = at + 1;"
            yield "at += 1 + (int)*at;"
        elif field.type.kind == "array":
            yield f"for (int i = 0; i < {field.type.length}; i++)"
            yield f"    constants->{name}[i] = *at++;"
        else:
            yield f"constants->{name} = ({field.type.cname})*at++;"


def report_fields(header: str) -> dict[str, tuple[int, int]]:
    """Return start index and length of each field of `lab_report`, from the text of lab.h."""
    match = re.search(r"typedef struct \{([^}]*)\} lab_report;", header)
    assert match is not None
    declared = re.sub(r"/\*.*?\*/|\bdouble\b|\s", "", match[1]).replace(";", ",").strip(",")
    fields, start = {}, 0
    for name, length in re.findall(r"(\w+)(?:\[(\d+)\])?", declared):
        fields[name] = (start, int(length or 1))
        start += int(length or 1)
    return fields
