"""Every formula of the controller, written once in CasADi; C is generated from here (`mpc/core/generate.py`).

Symbols, the same everywhere. They are columns.

=============  ====  ============================================================================================
y              2     v [m/s], omega [rad/s]: what the velocity model says, before slip
slip           8     see estimation/slip.py
pose           3     x, y [m], theta [rad] of the body in the frame of the reference
twist          2     v [m/s], omega [rad/s] of the body, slip included
command        2     v_ref [m/s], omega_ref [rad/s]
reference      4     x, y [m], theta [rad] where the robot should be, and the heading [rad] to hold there
dt             1     duration [s]
=============  ====  ============================================================================================

Source of the odometry: Guffanti et al., Sensors 2025, 25(11), 3553. The rest is derived where it stands.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from inspect import signature
from typing import Any

import casadi as ca

from diffdrive_mpc.models.pose import arc_displacement

TERM_INPUTS: Mapping[str, int] = {"pose": 3, "twist": 2, "command": 2, "reference": 4}
"""Inputs of a term and their lengths; a column `parameters` of the term's own length is the last one."""

VARIED = ("pose", "twist", "command")
"""Inputs by which a term is differentiated."""

# Arguments of the formulas by name; the others are scalars.
_SHAPES = {
    "y": (2, 1),
    "slip": (8, 1),
    "pose": (3, 1),
    "twist": (2, 1),
    "wanted": (2, 1),
    "inverse_gain": (2, 2),
    "row": (10, 1),
    "coefficients": (16, 1),
}


SLOW = 0.1
"""Slower than this a robot cannot make up for a lateral speed by its heading [m/s]."""


def body_twist(y: ca.SX, slip: ca.SX) -> ca.SX:
    """Twist (2) of the body for what the model says.

    The wheels turn as the model says but for an offset and a gain; the body follows them by the gains of its floor, and
    turns about a centre that may lie beside the origin of its frame.
    """
    v_offset, omega_gain, longitudinal_gain, yaw_gain, _, _, turn_left, _ = ca.vertsplit(slip)
    omega = omega_gain * yaw_gain * y[1]
    return ca.vertcat(longitudinal_gain * (y[0] + v_offset) + turn_left * omega, omega)


def turning_point(slip: ca.SX, acceleration: ca.SX) -> ca.SX:
    """How far ahead of the origin the robot turns [m] where it does not side-slip.

    Under a forward `acceleration` [m/s^2] load shifts to the rear axle, which then holds the floor better.
    """
    turn_ahead, load_shift = slip[5], slip[7]
    return turn_ahead - load_shift * acceleration


def lateral_speed(v: ca.SX, omega: ca.SX, side_slip: ca.SX, ahead: ca.SX) -> ca.SX:
    """Speed of the origin to the left [m/s], the turning point lying `ahead` [m] of it; side-slip is outward."""
    return -(ahead + side_slip * v) * omega


def displacement(y: ca.SX, slip: ca.SX, theta: ca.SX, acceleration: ca.SX, dt: ca.SX) -> ca.SX:
    """Displacement (3) dx, dy [m], dtheta [rad] over `dt` along the exact arc of the body's twist, side-slip included.

    Source: `models/pose.py`.
    """
    v, omega = ca.vertsplit(body_twist(y, slip))
    return arc_displacement(theta, v, omega, dt, lateral_speed(v, omega, slip[4], turning_point(slip, acceleration)))


def sensed(y: ca.SX, slip: ca.SX, gyro_bias: ca.SX, wheel_yaw_ratio: ca.SX) -> ca.SX:
    """What the sensors of motion read (3): wheel speed [m/s], the wheels' yaw rate and the gyro's [rad/s].

    Wheel speed = y_v + v_offset. The encoders see the wheels, and divide by the geometric track instead of the one of
    the model: wheel yaw rate = wheel_yaw_ratio omega_gain y_omega. The gyro sees the body: omega + gyro_bias.
    """
    v_offset, omega_gain = slip[0], slip[1]
    omega = body_twist(y, slip)[1]
    return ca.vertcat(y[0] + v_offset, wheel_yaw_ratio * omega_gain * y[1], omega + gyro_bias)


def aim(pose: ca.SX, twist: ca.SX, slip: ca.SX) -> ca.SX:
    """What the robot should aim at (4) for the reference's `pose` and `twist`: see `reference` above.

    To hold its path in a curve a robot that slips to the side must lead it by the angle of its lateral speed.
    """
    v, omega = ca.vertsplit(twist)
    sideways = slip[4] + slip[5] * v / (v**2 + SLOW**2)
    return ca.vertcat(pose, pose[2] + ca.atan(sideways * omega))


def feed_forward(wanted: ca.SX, slip: ca.SX, inverse_gain: ca.SX) -> ca.SX:
    """Command (2) that keeps the body's twist `wanted` (2).

    The model's steady-state gain and the estimated slip are inverted, `inverse_gain` (2 x 2) being the first of these.
    """
    v_offset, omega_gain, longitudinal_gain, yaw_gain, _, _, turn_left, _ = ca.vertsplit(slip)
    forward = wanted[0] - turn_left * wanted[1]
    return inverse_gain @ ca.vertcat(forward / longitudinal_gain - v_offset, wanted[1] / (omega_gain * yaw_gain))


def across_path(pose: ca.SX, reference: ca.SX) -> ca.SX:
    """Distance [m] of the pose to the left of the reference's tangent."""
    dx, dy, theta = pose[0] - reference[0], pose[1] - reference[1], reference[2]
    return ca.cos(theta) * dy - ca.sin(theta) * dx


def tracking_errors(pose: ca.SX, reference: ca.SX) -> ca.SX:
    """Errors (3) along and across the reference's tangent [m], and of the heading [rad] to the one to hold."""
    dx, dy, theta = pose[0] - reference[0], pose[1] - reference[1], reference[2]
    along = ca.cos(theta) * dx + ca.sin(theta) * dy
    return ca.vertcat(along, across_path(pose, reference), pose[2] - reference[3])


def softly_limited(pose: ca.SX, twist: ca.SX, reference: ca.SX, parameters: ca.SX) -> ca.SX:
    """What has soft limits (5): v [m/s], omega [rad/s], right and left wheel speed at the rim [m/s], distance [m].

    The wheels do not slip as the body does: at the rim the gains of slip are undone. `parameters` (9) are slip and half
    the track of the wheels [m].
    """
    _, omega_gain, longitudinal_gain, yaw_gain, _, _, turn_left, _, half_track = ca.vertsplit(parameters)
    forward = (twist[0] - turn_left * twist[1]) / longitudinal_gain
    turning = half_track * twist[1] / (omega_gain * yaw_gain)
    return ca.vertcat(twist, forward + turning, forward - turning, across_path(pose, reference))


def arc_piece(tau: ca.SX, row: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Pose (3), twist (2) and arc length (1) of a reference of exact arcs, `tau` [s] after its phase began.

    `row` (10) is the phase: its start time; x, y, theta and arc length at the start of its stretch; forward [m] and
    turn [rad] per unit of progress; progress s, its rate and half its acceleration at the start of the phase. So
    s(tau) = s + (s' + s''/2 tau) tau, and the stretch up to there is the arc of the twist (forward, turn) over s(tau).
    """
    _, x, y, theta, arc_length, forward, turn, offset, rate, half_acceleration = ca.vertsplit(row)
    progress = offset + (rate + half_acceleration * tau) * tau
    speed = rate + 2 * half_acceleration * tau
    pose = ca.vertcat(x, y, theta) + arc_displacement(theta, forward, turn, progress, ca.SX(0))
    return pose, ca.vertcat(forward, turn) * speed, arc_length + ca.fabs(forward * progress)


def spline_piece(tau: ca.SX, coefficients: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Pose (3), twist (2) and arc length (1) of a reference of cubic pieces in time, `tau` [s] after the piece began.

    `coefficients` (16) are those of x, y, theta and arc length for each power of tau, highest power first. The forward
    speed is the rate of (x, y) along the heading.
    """
    cubic, square, linear, constant = ca.vertsplit(coefficients, 4)
    value = ((cubic * tau + square) * tau + linear) * tau + constant
    rate = (3 * cubic * tau + 2 * square) * tau + linear
    v = rate[0] * ca.cos(value[2]) + rate[1] * ca.sin(value[2])
    return value[:3], ca.vertcat(v, rate[2]), value[3]


def arc_move(theta: ca.SX, v: ca.SX, omega: ca.SX, side_slip: ca.SX, ahead: ca.SX, dt: ca.SX) -> ca.SX:
    """Displacement (2) dx, dy [m] over `dt` along the same arc as in `displacement`, for a twist that includes slip."""
    return arc_displacement(theta, v, omega, dt, lateral_speed(v, omega, side_slip, ahead))[:2]


@cache
def formulas() -> tuple[ca.Function, ...]:
    """The controller's formulas as SX functions, named as they are in C. Those that vary carry their gradient."""
    sampled = ("pose", "twist", "arc_length")
    return (
        _varied("ddmpc_f_twist", body_twist, "twist", ("y", "slip")),
        _varied("ddmpc_f_move", displacement, "displacement", ("y", "slip", "theta")),
        _varied("ddmpc_f_sensors", sensed, "sensed", ("y", "slip", "gyro_bias")),
        _varied("ddmpc_f_arc", arc_move, "move", ("v", "omega", "theta")),
        _plain("ddmpc_f_turning_point", turning_point, "ahead"),
        _plain("ddmpc_f_aim", aim, "aim"),
        _plain("ddmpc_f_feed_forward", feed_forward, "command"),
        _term("ddmpc_f_errors", tracking_errors, 0),
        _term("ddmpc_f_soft", softly_limited, 9),
        _plain("ddmpc_f_arc_piece", arc_piece, *sampled),
        _plain("ddmpc_f_spline_piece", spline_piece, *sampled),
    )


def formula(name: str) -> ca.Function:
    """The formula `ddmpc_f_NAME`, to evaluate with numbers; with more columns it answers for each of them."""
    return {one.name(): one for one in formulas()}[f"ddmpc_f_{name}"]


def term_symbols(parameters: int) -> dict[str, ca.SX]:
    """The inputs of a term by name, with `parameters` stage parameters."""
    return {name: ca.SX.sym(name, length) for name, length in {**TERM_INPUTS, "parameters": parameters}.items()}


def term(name: str, inputs: Mapping[str, ca.SX], value: ca.SX) -> ca.Function:
    """The term `value` (m) of `inputs`, see `term_symbols`, with its gradient (m x 7) by pose, twist and command."""
    return differentiated(name, inputs, "value", value, VARIED)


def differentiated(name: str, inputs: Mapping[str, ca.SX], output: str, value: ca.SX, by: Sequence[str]) -> ca.Function:
    """The function `name` of `inputs` with two outputs: `value`, called `output`, and its gradient by `by`."""
    gradient = ca.jacobian(value, ca.vertcat(*(inputs[varied] for varied in by)))
    return named_function(name, inputs, {output: value, "gradient": gradient})


_Formula = Callable[..., Any]


def _symbols(formula: _Formula) -> dict[str, ca.SX]:
    return {name: ca.SX.sym(name, *_SHAPES.get(name, (1, 1))) for name in signature(formula).parameters}


def _varied(name: str, formula: _Formula, output: str, by: Sequence[str]) -> ca.Function:
    inputs = _symbols(formula)
    return differentiated(name, inputs, output, formula(**inputs), by)


def _plain(name: str, formula: _Formula, *outputs: str) -> ca.Function:
    inputs = _symbols(formula)
    values = formula(**inputs)
    return named_function(name, inputs, dict(zip(outputs, values if len(outputs) > 1 else [values], strict=True)))


def _term(name: str, formula: _Formula, parameters: int) -> ca.Function:
    inputs = term_symbols(parameters)
    return term(name, inputs, formula(**{given: inputs[given] for given in signature(formula).parameters}))


def named_function(name: str, inputs: Mapping[str, ca.SX], outputs: Mapping[str, ca.SX]) -> ca.Function:
    """The function `name` with these inputs and outputs."""
    return ca.Function(name, list(inputs.values()), list(outputs.values()), list(inputs), list(outputs))
