"""Formulas of the simulated robot as CasADi functions, from which the C of the laboratory is generated."""

from __future__ import annotations

from typing import Any

import casadi as ca

from diffdrive_mpc.core_sources import GeneratedC, generate
from diffdrive_mpc.models.pose import arc_displacement
from diffdrive_mpc.sim.plants.surface import BodySlip

FLOOR = ("longitudinal_gain", "yaw_gain", "wheel_yaw_gain", "side_slip")
"""Fields of `BodySlip` that a floor of the laboratory has, in the order of the second argument of `lab_f_floor`."""


def generate_plant() -> GeneratedC:
    """C of the functions `lab_f_floor` and `lab_f_move`."""
    return generate(plant_functions(), "lab_plant", "app/lab/formulas.py")


def plant_functions() -> tuple[ca.Function, ca.Function]:
    """`lab_f_floor`: twist by model and floor to those of body and wheels; `lab_f_move`: a pose after a while."""
    return _floor(), _move()


def _floor() -> ca.Function:
    """Twist of the model (2) and floor (4) to the twist of the body (3) and that of the wheels (2)."""
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
    """Pose (3), twist of the body (3) and duration (1) to the pose (3) after it."""
    pose, body, duration = ca.SX.sym("pose", 3), ca.SX.sym("body", 3), ca.SX.sym("duration")
    after = pose + arc_displacement(pose[2], body[0], body[2], duration, body[1])
    return ca.Function("lab_f_move", [pose, body, duration], [after], ["pose", "body", "duration"], ["after"])
