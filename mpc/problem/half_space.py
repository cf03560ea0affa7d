"""The term that keeps one point of the robot on its side of a plane."""

from __future__ import annotations

import casadi as ca

from diffdrive_mpc.mpc.problem.formulas import term, term_symbols

PARAMETERS = 5
"""a (2), point d (2) of the robot in its own frame [m], b."""


def half_space(pose: ca.SX, parameters: ca.SX) -> ca.SX:
    """How far the point d of the robot is beyond a plane, a unit vector a leading to the far side [m].

    It is a . (position + R(heading) d) - b, no more than zero on the free side.
    """
    a, d, b = parameters[:2], parameters[2:4], parameters[4]
    cosine, sine = ca.cos(pose[2]), ca.sin(pose[2])
    point = pose[:2] + ca.vertcat(cosine * d[0] - sine * d[1], sine * d[0] + cosine * d[1])
    return ca.SX(ca.dot(a, point) - b)


def half_space_formula() -> ca.Function:
    """The same with its gradient, as it is in C."""
    inputs = term_symbols(PARAMETERS)
    return term("ddmpc_f_half_space", inputs, half_space(inputs["pose"], inputs["parameters"]))


def half_space_function() -> ca.Function:
    """The same as a function that a term takes."""
    pose, parameters = ca.SX.sym("pose", 3), ca.SX.sym("parameters", PARAMETERS)
    return ca.Function(
        "half_space", [pose, parameters], [half_space(pose, parameters)], ["pose", "parameters"], ["value"]
    )
