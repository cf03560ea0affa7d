"""Formulas of the controller in CasADi, from which C code is generated (`mpc/core/generate.py`).

The formulas use these symbols, which are column vectors:

=============  ====  ============================================================================================
y              2     v [m/s], omega [rad/s]: output of the velocity model, before slip
slip           10    see `mpc.problem.slip`; 15 in formulas whose name ends in `_curved`
pose           3     x, y [m], theta [rad] of the body in the frame of the reference
twist          2     v [m/s], omega [rad/s] of the body, including slip
command        2     v_ref [m/s], omega_ref [rad/s]
reference      4     x, y [m], theta [rad] of the reference pose, and the target heading [rad], see `aim`
dt             1     duration [s]
=============  ====  ============================================================================================

Source of the odometry: Guffanti et al., Sensors 2025, 25(11), 3553. For derivations and sources of other formulas see
their docstrings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from inspect import signature
from types import SimpleNamespace
from typing import Any

import casadi as ca

from diffdrive_mpc.models.lstm_cell import hidden, next_cell
from diffdrive_mpc.models.pose import arc_displacement
from diffdrive_mpc.models.slip_laws import track_widening
from diffdrive_mpc.mpc.problem.slip import FLAT_SLIPS, SLIPS

TERM_INPUTS: Mapping[str, int] = {"pose": 3, "twist": 2, "command": 2, "reference": 4}
"""Inputs of a term and their lengths, except for the last input `parameters`, whose length depends on the term."""

DIFFERENTIATED = ("pose", "twist", "command")
"""Inputs by which a term is differentiated."""

# Shapes of the arguments of formulas by name; other arguments are scalars.
_SHAPES = {
    "y": (2, 1),
    "pose": (3, 1),
    "twist": (2, 1),
    "target_twist": (2, 1),
    "inverse_gain": (2, 2),
    "row": (10, 1),
    "coefficients": (16, 1),
}


ALONG = 0.5
"""Ratio of the slide along the heading to the slide across the heading [-].

Rolling wheels resist sliding along the heading. Identified with four robots on the `mujoco` plant on a slope of 10
degrees (0.05 to 0.06 m/rad along, 0.10 to 0.12 m/rad across)."""
_SMOOTHING_RATE = 0.05  # yaw rate below which |omega| is smoothed in the slide [rad/s]
SLOW = 0.1
"""Speed below which the target heading compensates only a small part of a lateral speed [m/s]."""
# Number of fixed-point iterations in the inversion of curved slip.
_INVERSION_ITERATIONS = 3


def _slip_components(slip: ca.SX) -> SimpleNamespace:
    """Return the components of a slip column by name; curved slips are zero for a column of flat slips."""
    parts = ca.vertsplit(slip)
    return SimpleNamespace(**dict(zip(SLIPS, [*parts, *[ca.SX(0)] * (len(SLIPS) - len(parts))], strict=True)))


def _flat_twist(wheels: ca.SX, turn: ca.SX, s: SimpleNamespace) -> ca.SX:
    """Compute the part of the body's twist (2) that is affine in wheel speed and the model's yaw rate."""
    omega = s.omega_gain * s.yaw_gain * turn
    return ca.SX(ca.vertcat(s.longitudinal_gain * wheels + s.turn_left * omega, omega))


def _curve_twist(flat: ca.SX, wheels: ca.SX, turn: ca.SX, s: SimpleNamespace) -> ca.SX:
    """Add the curved terms to the twist `flat`: veer, couplings (a31, a13, a33 of P4), and the growth of the track."""
    product = wheels * s.omega_gain * turn
    v = flat[0] + s.forward_coupling * product
    omega = flat[1] / track_widening(flat[1], s.track_growth) + s.veer * wheels + s.yaw_coupling * product
    return ca.SX(ca.vertcat(v, omega))


def body_twist(y: ca.SX, slip: ca.SX) -> ca.SX:
    """Compute the twist (2) of the body from the output of the model.

    The wheels follow the model with an offset and a gain. The body follows the wheels with gains that depend on the
    surface, and turns about a point that may differ from the origin of the body frame.
    """
    return _twists(y, slip)[1]


def _twists(y: ca.SX, slip: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Compute the twist (2) of the body without and with the curved terms."""
    s = _slip_components(slip)
    wheels = y[0] + s.v_offset
    flat = _flat_twist(wheels, y[1], s)
    return flat, _curve_twist(flat, wheels, y[1], s)


def wheel_twist(twist: ca.SX, slip: ca.SX) -> ca.SX:
    """Compute wheel speed and model yaw rate (2) from the body's `twist`; the inverse of `body_twist`.

    Curved slip is inverted by a fixed-point iteration, whose error decreases by the product of the couplings in each
    iteration.
    """
    s = _slip_components(slip)
    gain = s.omega_gain * s.yaw_gain
    v, turn = (twist[0] - s.turn_left * twist[1]) / s.longitudinal_gain, twist[1] / gain
    for _ in range(0 if slip.numel() == len(FLAT_SLIPS) else _INVERSION_ITERATIONS):
        widening = track_widening(gain * turn, s.track_growth)
        turn = (twist[1] - s.veer * v) / (gain / widening + s.yaw_coupling * s.omega_gain * v)
        v = (twist[0] - s.turn_left * gain * turn) / (s.longitudinal_gain + s.forward_coupling * s.omega_gain * turn)
    return ca.SX(ca.vertcat(v, turn))


def _without_curved(twist: ca.SX, slip: ca.SX) -> ca.SX:
    """Remove the curved terms from the body's `twist` (2)."""
    if slip.numel() == len(FLAT_SLIPS):
        return twist
    wheels = wheel_twist(twist, slip)
    return _flat_twist(wheels[0], wheels[1], _slip_components(slip))


def turning_point(slip: ca.SX, acceleration: ca.SX) -> ca.SX:
    """Compute the distance of the turning point ahead of the origin [m], without the effect of side-slip.

    A forward `acceleration` [m/s^2] shifts load to the rear axle and thereby increases the grip of this axle.
    """
    s = _slip_components(slip)
    return ca.SX(s.turn_ahead - s.load_shift * acceleration)


def lateral_speed(flat: ca.SX, slip: ca.SX, ahead: ca.SX) -> ca.SX:
    """Compute the speed of the origin to the left [m/s] if the turning point is `ahead` [m] of the origin.

    Side-slip is directed outward. The argument `flat` is the twist without curved terms, so crab, turning point and
    side-slip correspond to a21, a22 and a23 of P4.
    """
    s, (v, omega) = _slip_components(slip), ca.vertsplit(flat)
    return ca.SX(s.crab * v - (ahead + s.side_slip * v) * omega)


def sliding(theta: ca.SX, omega: ca.SX, slide_x: ca.SX, slide_y: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Compute the sliding speed (along, across) [m/s] of a robot with heading `theta` and yaw rate `omega`.

    Friction acts against the skidding motion, so it resists a lateral force only in part. A downhill force therefore
    moves the robot in proportion to the skidding speed.
    """
    # |omega| has no gradient at zero.
    rate = ca.sqrt(omega**2 + _SMOOTHING_RATE**2) - _SMOOTHING_RATE
    along = ca.cos(theta) * slide_x + ca.sin(theta) * slide_y
    across = ca.cos(theta) * slide_y - ca.sin(theta) * slide_x
    return ALONG * rate * along, rate * across


def _arc_move(theta: ca.SX, twist: ca.SX, flat: ca.SX, slip: ca.SX, ahead: ca.SX, dt: ca.SX) -> ca.SX:
    """Compute the displacement (3) over `dt` along the arc of the body's `twist`, with sliding at the midpoint."""
    s = _slip_components(slip)
    along, across = sliding(theta + twist[1] * dt / 2, twist[1], s.slide_x, s.slide_y)
    return arc_displacement(theta, twist[0] + along, twist[1], dt, lateral_speed(flat, slip, ahead) + across)


def displacement(y: ca.SX, slip: ca.SX, theta: ca.SX, acceleration: ca.SX, dt: ca.SX) -> ca.SX:
    """Compute the displacement (3) dx, dy [m], dtheta [rad] over `dt` along the exact arc of the body's twist.

    Source: `models/pose.py`.
    """
    flat, twist = _twists(y, slip)
    return _arc_move(theta, twist, flat, slip, turning_point(slip, acceleration), dt)


def sensor_readings(y: ca.SX, slip: ca.SX, gyro_bias: ca.SX, wheel_yaw_ratio: ca.SX) -> ca.SX:
    """Compute the expected readings (3): wheel speed [m/s], yaw rate of the wheels and of the gyro [rad/s].

    The encoders measure the wheel speed y_v + v_offset and, with the geometric track, the wheel yaw rate
    wheel_yaw_ratio omega_gain y_omega. The gyro measures the yaw rate of the body plus its bias, omega + gyro_bias.
    """
    s = _slip_components(slip)
    omega = body_twist(y, slip)[1]
    return ca.vertcat(y[0] + s.v_offset, wheel_yaw_ratio * s.omega_gain * y[1], omega + gyro_bias)


def aim(pose: ca.SX, twist: ca.SX, slip: ca.SX, acceleration: ca.SX) -> ca.SX:
    """Return the target (4) for the reference's `pose` and `twist`, see `reference` in the table of the module.

    A robot with side-slip stays on a curved path if its heading is offset by the angle of its lateral speed, which
    depends on the reference's forward `acceleration` [m/s^2].
    """
    s = _slip_components(slip)
    v, omega = twist[0], _without_curved(twist, slip)[1]
    _, slide = sliding(pose[2], twist[1], s.slide_x, s.slide_y)
    # v / (v^2 + SLOW^2) replaces 1 / v, which is infinite at rest.
    outward = s.side_slip * omega + (turning_point(slip, acceleration) * omega - slide) * v / (v**2 + SLOW**2)
    return ca.vertcat(pose, pose[2] + ca.atan(outward - s.crab))


def feed_forward(target_twist: ca.SX, slip: ca.SX, inverse_gain: ca.SX) -> ca.SX:
    """Compute the command (2) that produces the steady twist `target_twist` (2) of the body.

    The command inverts the estimated slip and the steady-state gain of the model, whose inverse is `inverse_gain`
    (2 x 2).
    """
    wheels = wheel_twist(target_twist, slip)
    return inverse_gain @ ca.vertcat(wheels[0] - _slip_components(slip).v_offset, wheels[1])


def across_path(pose: ca.SX, reference: ca.SX) -> ca.SX:
    """Compute the distance [m] of the pose to the left of the reference's tangent."""
    dx, dy, theta = pose[0] - reference[0], pose[1] - reference[1], reference[2]
    return ca.cos(theta) * dy - ca.sin(theta) * dx


def tracking_errors(pose: ca.SX, reference: ca.SX) -> ca.SX:
    """Compute the errors (3) along and across the reference's tangent [m], and relative to the target heading [rad]."""
    dx, dy, theta = pose[0] - reference[0], pose[1] - reference[1], reference[2]
    along = ca.cos(theta) * dx + ca.sin(theta) * dy
    return ca.vertcat(along, across_path(pose, reference), pose[2] - reference[3])


def soft_limit_values(pose: ca.SX, twist: ca.SX, reference: ca.SX, parameters: ca.SX) -> ca.SX:
    """Compute the soft-limited values (5): v, omega, right and left rim speed, and distance across [m/s, rad/s, m].

    The rim speeds do not include the slip of the body. `parameters` (11 or 16) are the slip and half the track of the
    wheels [m].
    """
    slip, half_track = parameters[:-1], parameters[-1]
    wheels = wheel_twist(twist, slip)
    turning = half_track * wheels[1]
    return ca.vertcat(twist, wheels[0] + turning, wheels[0] - turning, across_path(pose, reference))


def radius_violation(twist: ca.SX, parameters: ca.SX) -> ca.SX:
    """Compute the radius violation (2) of a twist to the left and to the right [m/s]; positive if violated.

    The constraint is |omega| radius <= |v| in the direction of travel (Ordonez et al., 2017). `parameters` (2) are the
    minimum radius [m], and the direction of the reference: 1 forwards, -1 backwards.
    """
    radius, direction = ca.vertsplit(parameters)
    turning, driving = radius * twist[1], direction * twist[0]
    return ca.vertcat(turning - driving, -turning - driving)


def commanded_radius_violation(command: ca.SX, parameters: ca.SX) -> ca.SX:
    """Compute the radius violation (2) of a command, as in P4; the radius is that of the wheels' path."""
    return radius_violation(command, parameters)


def arc_piece(tau: ca.SX, row: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Compute pose (3), twist (2) and arc length (1) of a reference of exact arcs, `tau` [s] after the phase start.

    `row` (10) describes the phase: start time; x, y, theta and arc length at the start of its segment; forward distance
    [m] and turn [rad] per unit of progress; progress s, its rate and half its acceleration at the start of the phase.
    The progress is s(tau) = s + (s' + s''/2 tau) tau, and the path from the start of the segment is the arc of the
    twist (forward, turn) over s(tau).
    """
    _, x, y, theta, arc_length, forward, turn, offset, rate, half_acceleration = ca.vertsplit(row)
    progress = offset + (rate + half_acceleration * tau) * tau
    speed = rate + 2 * half_acceleration * tau
    pose = ca.vertcat(x, y, theta) + arc_displacement(theta, forward, turn, progress, ca.SX(0))
    return pose, ca.vertcat(forward, turn) * speed, arc_length + ca.fabs(forward * progress)


def spline_piece(tau: ca.SX, coefficients: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Compute pose (3), twist (2) and arc length (1) of a cubic reference, `tau` [s] after the start of its piece.

    `coefficients` (16) are those of x, y, theta and arc length for each power of tau, highest power first. The forward
    speed is the rate of (x, y) along the heading.
    """
    cubic, square, linear, constant = ca.vertsplit(coefficients, 4)
    value = ((cubic * tau + square) * tau + linear) * tau + constant
    rate = (3 * cubic * tau + 2 * square) * tau + linear
    v = rate[0] * ca.cos(value[2]) + rate[1] * ca.sin(value[2])
    return value[:3], ca.vertcat(v, rate[2]), value[3]


def arc_move(theta: ca.SX, v: ca.SX, omega: ca.SX, slip: ca.SX, ahead: ca.SX, dt: ca.SX) -> ca.SX:
    """Compute the displacement (2) dx, dy [m] over `dt` of a twist that includes slip; see `displacement`."""
    twist = ca.vertcat(v, omega)
    return _arc_move(theta, twist, _without_curved(twist, slip), slip, ahead, dt)[:2]


@cache
def formulas() -> tuple[ca.Function, ...]:
    """Build the formulas as SX functions with their C names, and with gradients if the core linearises them.

    Formulas with slip exist in two versions, so that controllers without curved slip do not evaluate its terms.
    """
    sampled = ("pose", "twist", "arc_length")
    return (
        *_with_slip("", len(FLAT_SLIPS)),
        *_with_slip("_curved", len(SLIPS)),
        _term("ddmpc_f_errors", tracking_errors, 0),
        _term("ddmpc_f_turn", radius_violation, 2),
        _term("ddmpc_f_command_turn", commanded_radius_violation, 2),
        _plain("ddmpc_f_arc_piece", arc_piece, *sampled),
        _plain("ddmpc_f_spline_piece", spline_piece, *sampled),
    )


def _with_slip(suffix: str, slips: int) -> tuple[ca.Function, ...]:
    """Build the formulas that depend on slip, for a slip column of length `slips`."""
    shapes = {"slip": (slips, 1)}
    return (
        _with_gradient(f"ddmpc_f_twist{suffix}", body_twist, "twist", ("y", "slip"), shapes),
        _with_gradient(f"ddmpc_f_move{suffix}", displacement, "displacement", ("y", "slip", "theta"), shapes),
        _with_gradient(f"ddmpc_f_sensors{suffix}", sensor_readings, "sensed", ("y", "slip", "gyro_bias"), shapes),
        _with_gradient(f"ddmpc_f_arc{suffix}", arc_move, "move", ("v", "omega", "theta"), shapes),
        _plain(f"ddmpc_f_turning_point{suffix}", turning_point, "ahead", shapes=shapes),
        _plain(f"ddmpc_f_aim{suffix}", aim, "aim", shapes=shapes),
        _plain(f"ddmpc_f_feed_forward{suffix}", feed_forward, "command", shapes=shapes),
        _term(f"ddmpc_f_soft{suffix}", soft_limit_values, slips + 1),
    )


def formula(name: str) -> ca.Function:
    """Build the formula `ddmpc_f_NAME` for numerical evaluation."""
    return {function.name(): function for function in formulas()}[f"ddmpc_f_{name}"]


def term_symbols(parameters: int) -> dict[str, ca.SX]:
    """Create the inputs of a term by name, with `parameters` stage parameters."""
    return {name: ca.SX.sym(name, length) for name, length in {**TERM_INPUTS, "parameters": parameters}.items()}


def term(name: str, inputs: Mapping[str, ca.SX], value: ca.SX) -> ca.Function:
    """Build the term `value` (m) of `inputs`, see `term_symbols`, with its gradient (m x 7) by `DIFFERENTIATED`."""
    return differentiate(name, inputs, "value", value, DIFFERENTIATED)


def differentiate(name: str, inputs: Mapping[str, ca.SX], output: str, value: ca.SX, by: Sequence[str]) -> ca.Function:
    """Build the function `name` of `inputs` with two outputs: `value`, named `output`, and its gradient by `by`."""
    gradient = ca.jacobian(value, ca.vertcat(*(inputs[varied] for varied in by)))
    return named_function(name, inputs, {output: value, "gradient": gradient})


_Formula = Callable[..., Any]


_Shapes = Mapping[str, tuple[int, int]]


def _symbols(formula: _Formula, shapes: _Shapes) -> dict[str, ca.SX]:
    sizes = {**_SHAPES, **shapes}
    return {name: ca.SX.sym(name, *sizes.get(name, (1, 1))) for name in signature(formula).parameters}


def _with_gradient(name: str, formula: _Formula, output: str, by: Sequence[str], shapes: _Shapes) -> ca.Function:
    inputs = _symbols(formula, shapes)
    return differentiate(name, inputs, output, formula(**inputs), by)


def _plain(name: str, formula: _Formula, *outputs: str, shapes: _Shapes | None = None) -> ca.Function:
    inputs = _symbols(formula, shapes or {})
    values = formula(**inputs)
    return named_function(name, inputs, dict(zip(outputs, values if len(outputs) > 1 else [values], strict=True)))


def _term(name: str, formula: _Formula, parameters: int) -> ca.Function:
    inputs = term_symbols(parameters)
    return term(name, inputs, formula(**{argument: inputs[argument] for argument in signature(formula).parameters}))


def named_function(name: str, inputs: Mapping[str, ca.SX], outputs: Mapping[str, ca.SX]) -> ca.Function:
    """Build the function `name` with named inputs and outputs."""
    return ca.Function(name, list(inputs.values()), list(outputs.values()), list(inputs), list(outputs))


@cache
def network_formulas() -> tuple[ca.Function, ...]:
    """Build the formulas of network units with gradients, for the C code of `mpc/core/network.c`.

    The formulas are the cell and the output of an LSTM unit, and the activation of a dense layer.
    """
    names = ("enter", "keep", "candidate", "leave", "cell", "x")
    enter, keep, candidate, leave, cell, x = (ca.SX.sym(name) for name in names)
    cell_inputs = {"enter": enter, "keep": keep, "candidate": candidate, "cell": cell}
    hidden_inputs = {"leave": leave, "cell": cell}
    next_value = next_cell(enter, keep, candidate, cell, ca.tanh)
    return (
        differentiate("ddmpc_f_cell", cell_inputs, "next_cell", next_value, tuple(cell_inputs)),
        differentiate("ddmpc_f_hidden", hidden_inputs, "hidden", hidden(leave, cell, ca.tanh), tuple(hidden_inputs)),
        differentiate("ddmpc_f_dense", {"x": x}, "y", ca.tanh(x), ("x",)),
    )
