"""Formulas compared with finite differences, the polynomial of P4, and the generated C code."""

import subprocess

import casadi as ca
import cffi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc import ConfigError
from diffdrive_mpc.models.slip_laws import polynomial_twist
from diffdrive_mpc.mpc.core.generate import generate, generate_formulas
from diffdrive_mpc.mpc.problem.formulas import formulas
from diffdrive_mpc.mpc.problem.slip import CURVED_SLIPS, FLAT_SLIPS, SLIPS, Slip
from diffdrive_mpc.mpc.problem.user_functions import user_output, user_step, user_term

FORMULAS = {function.name().removeprefix("ddmpc_f_"): function for function in formulas()}
# Plausible values of a robot; gains are not near zero.
RANGES = {
    "y": [(-2, 2), (-3, 3)],
    "slip": [
        *((-0.3, 0.3), (0.3, 2), (0.3, 2), (0.3, 2), (-0.2, 0.2), (-0.2, 0.2), (-0.2, 0.2), (-0.1, 0.1)),
        *((-0.2, 0.2), (-0.2, 0.2)),  # slide
        # Crab, veer, couplings and growth of the track, as on real surfaces.
        *((-0.05, 0.05), (-0.05, 0.05), (-0.05, 0.05), (-0.05, 0.05), (-0.1, 0.2)),
    ],
    "pose": [(-5, 5), (-5, 5), (-7, 7)],
    "twist": [(-2, 2), (-3, 3)],
    "command": [(-2, 2), (-3, 3)],
    "target_twist": [(-2, 2), (-3, 3)],
    "reference": [(-5, 5), (-5, 5), (-7, 7), (-7, 7)],
    "theta": [(-7, 7)],
    "dt": [(1e-3, 0.5)],
    "tau": [(0, 2)],
    "gyro_bias": [(-0.1, 0.1)],
    "wheel_yaw_ratio": [(0.3, 3)],
    "acceleration": [(-5, 5)],
    "ahead": [(-0.5, 0.5)],
    "inverse_gain": [(-2, 2)] * 4,
    "v": [(-2, 2)],
    "omega": [(-3, 3)],
    "row": [(0, 9), (-5, 5), (-5, 5), (-7, 7), (0, 50), (-1, 1), (-2, 2), (0, 3), (-2, 2), (-1, 1)],
    "coefficients": [(-2, 2)] * 16,
}


def numbers(low, high):
    near_zero = [st.floats(-1e-6, 1e-6), st.just(0.0)] if low < 0 < high else []
    return st.one_of(st.floats(low, high), *near_zero)


HALF_TRACK_RANGE = (0.1, 1)


def argument_strategy(function, k):
    name, count = function.name_in(k), function.numel_in(k)
    # The parameters of the soft limits are the slip and half of the track.
    ranges = [*RANGES["slip"][: max(0, count - 1)], HALF_TRACK_RANGE] if name == "parameters" else RANGES[name][:count]
    ranges = ranges[:count]
    return st.tuples(*(numbers(low, high) for low, high in ranges)).map(lambda column: np.array(column, dtype=float))


def arguments_strategy(function):
    return st.tuples(*(argument_strategy(function, k) for k in range(function.n_in())))


def call(function, values):
    """Return the results as arrays, with column vectors flattened."""
    reshaped = [np.reshape(value, function.size_in(k), order="F") for k, value in enumerate(values)]
    results = function.call([ca.DM(value) for value in reshaped])
    return [np.array(result).ravel() if result.shape[1] == 1 else np.array(result) for result in results]


WITH_GRADIENT = [function for function in formulas() if function.name_out(function.n_out() - 1) == "gradient"]
# Inputs in the order of the gradient's columns.
GRADIENT_INPUTS = {
    "twist": ["y", "slip"],
    "move": ["y", "slip", "theta"],
    "sensors": ["y", "slip", "gyro_bias"],
    "arc": ["v", "omega", "theta"],
    "twist_curved": ["y", "slip"],
    "move_curved": ["y", "slip", "theta"],
    "sensors_curved": ["y", "slip", "gyro_bias"],
    "arc_curved": ["v", "omega", "theta"],
    "soft_curved": ["pose", "twist", "command"],
    "turn": ["pose", "twist", "command"],
    "command_turn": ["pose", "twist", "command"],
    "errors": ["pose", "twist", "command"],
    "soft": ["pose", "twist", "command"],
}


@pytest.mark.parametrize("function", WITH_GRADIENT, ids=lambda function: function.name())
@given(data=st.data())
def test_gradients_agree_with_finite_differences(function, data):
    values = list(data.draw(arguments_strategy(function)))
    _, gradient = call(function, values)
    name = function.name().removeprefix("ddmpc_f_")
    step, indices = 1e-6, [function.index_in(input_name) for input_name in GRADIENT_INPUTS[name]]
    sizes = [values[index].size for index in indices]
    # CasADi evaluates the function for each column, that is, for all directions at once.
    columns = [np.tile(np.reshape(value, (-1, 1)), (1, 2 * sum(sizes))) for value in values]
    for start, index, size in zip(np.cumsum([0, *sizes]), indices, sizes, strict=False):
        columns[index][:, start : start + size] += step * np.eye(size)
        columns[index][:, sum(sizes) + start : sum(sizes) + start + size] -= step * np.eye(size)
    ends = np.array(function.call([ca.DM(column) for column in columns])[0])
    slopes = (ends[:, : sum(sizes)] - ends[:, sum(sizes) :]) / (2 * step)
    assert np.isfinite(gradient).all()
    # A track that grows with the yaw rate has a kink in its second derivative at zero yaw rate.
    assert gradient == pytest.approx(slopes, abs=2e-6 if name.endswith("curved") else 2e-7)


# Curved slip.


def slip_parameters(**values):
    return [getattr(Slip(**values), name) for name in SLIPS]


@pytest.mark.parametrize("name", ["twist", "move", "sensors", "arc", "turning_point", "aim", "feed_forward", "soft"])
@given(data=st.data())
def test_curved_formula_without_curvature_equals_the_flat_formula(name, data):
    flat = FORMULAS[name]
    values = list(data.draw(arguments_strategy(flat)))
    expected = call(flat, values)
    index = flat.index_in("parameters" if name == "soft" else "slip")
    padded = np.zeros(len(CURVED_SLIPS))
    values[index] = np.insert(values[index], len(FLAT_SLIPS), padded)
    result = call(FORMULAS[f"{name}_curved"], values)
    assert result[0] == pytest.approx(expected[0], abs=1e-12)
    if name in ("arc", "soft"):
        assert result[1] == pytest.approx(expected[1], abs=1e-10)


@given(
    st.lists(st.floats(-0.05, 0.05), min_size=7, max_size=7),
    st.tuples(st.floats(-0.45, 0.1), st.floats(-0.12, 0.12)),
    st.floats(-1, 1),
    st.floats(-1, 1),
)
def test_feed_forward_inverts_the_slip_of_real_surfaces(small_terms, turn_terms, v, omega):
    """The ranges include the surfaces of P4: a32 is -0.34 to -0.41, a33 up to 0.12, and most others are below 0.05."""
    coefficients = np.array([*small_terms, *turn_terms])
    slip = [getattr(Slip.of_polynomial(coefficients), name) for name in SLIPS]
    (y,) = call(FORMULAS["feed_forward_curved"], [[v, omega], slip, [1, 0, 0, 1]])
    twist, _ = call(FORMULAS["twist_curved"], [y, slip])
    assert twist == pytest.approx([v, omega], abs=5e-3)


@given(st.lists(st.floats(-0.1, 0.1), min_size=9, max_size=9), st.floats(-1, 1), st.floats(-2, 2), st.floats(-3, 3))
def test_slip_terms_equal_the_polynomial_of_p4(coefficients, v, omega, theta):
    """The motion in a short time equals the polynomial except for a lateral term in the square of the yaw rate."""
    coefficients = np.array(coefficients)
    slip, dt = Slip.of_polynomial(coefficients), 1e-7
    assert slip.polynomial == pytest.approx(coefficients, abs=0.012)
    assert np.delete(slip.polynomial, 4) == pytest.approx(np.delete(coefficients, 4), abs=1e-12)
    motion, _ = call(
        FORMULAS["move_curved"], [[v, omega], [getattr(slip, name) for name in SLIPS], [theta], [0.0], [dt]]
    )
    c, s = np.cos(theta), np.sin(theta)
    forward, lateral = (c * motion[0] + s * motion[1]) / dt, (c * motion[1] - s * motion[0]) / dt
    expected = polynomial_twist(coefficients, [v, omega])
    a12, a21, a23 = coefficients[[1, 3, 5]]
    lateral_term = a12 / (1 + coefficients[0]) * omega * (a21 + a23 * omega)
    assert [forward, lateral - lateral_term, motion[2] / dt] == pytest.approx(expected, abs=1e-6)


@given(st.floats(-0.2, 2), st.floats(-1, 1), st.floats(-2, 2))
def test_track_growth_changes_the_wheel_speeds_of_a_turn(growth, v, omega):
    """P3: i = p1 |yaw rate| + p0; wheel speeds differ by i times the yaw rate, with equal values in both directions."""
    slip = slip_parameters(track_growth=growth)
    (forward, result), _ = call(FORMULAS["twist_curved"], [[v, omega], slip])
    _, mirrored = call(FORMULAS["twist_curved"], [[v, -omega], slip])[0]
    if growth * abs(omega) > -0.2:
        assert result * (1 + growth * abs(result)) == pytest.approx(omega, abs=1e-9)
    assert mirrored == -result
    assert forward == v
    # The feed-forward gives the wheel speeds of this turn.
    (y,) = call(FORMULAS["feed_forward_curved"], [[forward, result], slip, [1, 0, 0, 1]])
    if growth >= 0 and growth * abs(omega) < 0.3:
        assert y == pytest.approx([v, omega], abs=0.02)


@pytest.mark.parametrize("side", [-1, 1])
def test_arc_and_gradient_are_continuous_at_the_end_of_the_series(side):
    values_on_both_sides = [
        call(FORMULAS["arc"], [[0.3], [1.0], [side * 0.4 * (1 + e)], Slip(side_slip=0.1).flat, [0.05], [1.0]])
        for e in (-1e-15, 1e-15)
    ]
    for below, above in zip(*values_on_both_sides, strict=True):
        assert below == pytest.approx(above, abs=3e-15)


# Generated C code.

REAL_H = """
#ifndef REAL_H
#define REAL_H
#include <math.h>
#ifdef DDMPC_FLOAT
typedef float real;
#define R(number) number##f
#else
typedef double real;
#define R(number) number
#endif
#endif
"""
STRICT = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-Wdouble-promotion", "-Wfloat-conversion"]
STRICT.append("-Wno-unused-but-set-variable")  # CasADi loads inputs that it does not use


def compile_functions(generated, folder, precision):
    (folder / "real.h").write_text(REAL_H)
    (folder / f"{generated.stem}.h").write_text(generated.header)
    source, library = folder / f"{generated.stem}.c", folder / f"{generated.stem}-{precision}.so"
    source.write_text(generated.source)
    single = ["-DDDMPC_FLOAT"] if precision == "float" else []
    subprocess.run(["gcc", *STRICT, *single, "-O2", "-shared", "-fPIC", source, "-o", library, "-lm"], check=True)
    ffi = cffi.FFI()
    lines = [line for line in generated.header.splitlines() if line.startswith("int ")]
    ffi.cdef(f"typedef {precision} real;" + "\n".join(lines))
    return ffi, ffi.dlopen(str(library))


def call_compiled(ffi, library, precision, function, values):
    inputs = [ffi.new(f"{precision}[]", np.ravel(value).tolist() or 1) for value in values]
    outputs = [
        np.zeros(function.numel_out(k), np.float32 if precision == "float" else float) for k in range(function.n_out())
    ]
    results = [ffi.from_buffer(f"{precision}[]", memory) for memory in outputs]
    pointers = ffi.new("const real *[]", inputs), ffi.new("real *[]", results)
    assert getattr(library, function.name())(*pointers, ffi.NULL, ffi.NULL, 0) == 0
    shaped = [memory.reshape(function.size_out(k), order="F") for k, memory in enumerate(outputs)]
    return [memory.ravel() if memory.shape[1] == 1 else memory for memory in shaped]


@pytest.fixture(scope="module", params=["double", "float"])
def precision(request):
    return request.param


@pytest.fixture(scope="module")
def library(precision, tmp_path_factory):
    return compile_functions(generate_formulas(), tmp_path_factory.mktemp("formulas"), precision)


@pytest.mark.parametrize("function", formulas(), ids=lambda function: function.name())
@given(data=st.data())
def test_generated_c_equals_casadi(library, precision, function, data):
    values = data.draw(arguments_strategy(function))
    if precision == "float":
        values = [value.astype(np.float32).astype(float) for value in values]
    expected = call(function, values)
    computed = call_compiled(*library, precision, function, values)
    for actual, expected_value in zip(computed, expected, strict=True):
        rounding = 1e-13 if precision == "double" else 2e-5
        assert actual == pytest.approx(expected_value, abs=rounding * max(1.0, np.abs(expected_value).max()))


def test_single_precision_code_uses_no_doubles(tmp_path):
    """The machine code has no instructions for doubles and no calls of functions of doubles."""
    generated = generate_formulas()
    compile_functions(generated, tmp_path, "float")
    listing = subprocess.run(
        ["objdump", "-d", "-r", tmp_path / f"{generated.stem}-float.so"], capture_output=True, text=True, check=True
    ).stdout
    assert "sinf" in listing
    for double_code in ("cvtss2sd", "mulsd", "addsd", "<sin@plt>", "<cos@plt>", "<atan@plt>"):
        assert double_code not in listing


def test_generated_text_is_deterministic():
    assert generate_formulas() == generate_formulas()


# User functions.


def point_distance():
    """Return a user residual: depth of the robot inside a circle about a moving point, zero outside the circle."""
    pose, parameters = ca.SX.sym("pose", 3), ca.SX.sym("parameters", 3)
    distance = ca.sqrt(ca.sumsqr(pose[:2] - parameters[:2]) + 1e-6)
    return ca.Function(
        "keep_off", [parameters, pose], [ca.fmax(parameters[2] - distance, 0)], ["parameters", "pose"], ["r"]
    )


def test_user_term_has_the_inputs_and_gradient_of_a_shipped_term(tmp_path, precision):
    function = user_term(point_distance(), "user_keep_off")
    assert [function.name_in(k) for k in range(5)] == ["pose", "twist", "command", "reference", "parameters"]
    assert function.size_out(1) == (1, 7)
    values = [[1.0, 2.0, 0.3], [0, 0], [0, 0], [0, 0, 0, 0], [1.5, 2.0, 0.8]]
    value, gradient = call_compiled(
        *compile_functions(generate([function], "user", "a test"), tmp_path, precision), precision, function, values
    )
    rounding = 1e-9 if precision == "double" else 1e-6
    assert value == pytest.approx(0.8 - np.sqrt(0.25 + 1e-6), abs=rounding)
    assert gradient[0] == pytest.approx([1, 0, 0, 0, 0, 0, 0], abs=1e-5)


def test_every_operation_of_c99_is_generated(tmp_path, precision):
    x = ca.SX.sym("pose", 3)
    a, b, c = ca.vertsplit(x)
    unary = ["sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "atanh"]
    unary += ["exp", "log1p", "expm1", "erf"]
    values = [getattr(ca, name)(a) for name in unary] + [ca.acosh(b), ca.log(b), ca.sqrt(b)]
    values += [ca.floor(b), ca.ceil(b), ca.fmod(b, a), ca.fabs(c), ca.sign(c), ca.copysign(a, c), ca.atan2(a, c)]
    values += [ca.fmin(a, b), ca.fmax(a, b), ca.hypot(a, b), b**2.5, b**3, 1 / b, ca.remainder(b, a), c**2]
    values += [ca.if_else(a > b, a, b), ca.logic_and(a > 0, c != 0), ca.logic_or(a >= b, c == 0), ca.logic_not(a)]
    values += [ca.fmin(a, ca.inf), a * 1e-30, a + 1e5]
    function = user_term(ca.Function("many", [x], [ca.vertcat(*values)], ["pose"], ["value"]), "many")
    inputs = [[0.5, 1.75, -0.25], [0, 0], [0, 0], [0, 0, 0, 0], []]
    expected = call(function, inputs)[0]
    computed = call_compiled(
        *compile_functions(generate([function], "many", "a test"), tmp_path, precision), precision, function, inputs
    )[0]
    assert computed == pytest.approx(expected, rel=1e-14 if precision == "double" else 3e-6)


def test_mx_function_is_accepted():
    twist = ca.MX.sym("twist", 2)
    function = user_term(ca.Function("fast", [twist], [ca.norm_2(twist)], ["twist"], ["value"]), "fast")
    value, gradient = call(function, [np.zeros(3), [3.0, 4.0], np.zeros(2), np.zeros(4), []])
    assert value == pytest.approx(5.0)
    assert gradient[0] == pytest.approx([0, 0, 0, 0.6, 0.8, 0, 0])


def lag():
    """Return a first-order lag of both speeds after one sample of delay, with a saturating acceleration."""
    x, window = ca.SX.sym("x", 2), ca.SX.sym("window", 4)
    step = x + 0.2 * ca.tanh((window[:2] - x) / 0.4)
    return ca.Function("step", [x, window], [step], ["x", "window"], ["next"])


def test_functions_of_a_nonlinear_model_have_gradients(tmp_path, precision):
    functions = [user_step(lag(), "lag_step")]
    x = ca.SX.sym("x", 2)
    functions.append(user_output(ca.Function("output", [x], [x], ["x"], ["y"]), "lag_output", 2))
    library = compile_functions(generate(functions, "lag", "a test"), tmp_path, precision)
    rounding = 1e-14 if precision == "double" else 1e-6
    for function, values in zip(functions, [[[0.3, 0.1], [0.5, 0.2, 9.0, 9.0]], [[0.3, 0.1]]], strict=True):
        for computed, expected in zip(
            call_compiled(*library, precision, function, values), call(function, values), strict=True
        ):
            assert computed == pytest.approx(expected, abs=rounding)
    _, by_state, by_window = call(functions[0], [[0.3, 0.1], [0.5, 0.2, 9.0, 9.0]])
    slope = 0.5 * (1 - np.tanh((np.array([0.5, 0.2]) - [0.3, 0.1]) / 0.4) ** 2)
    assert by_state == pytest.approx(np.eye(2) - np.diag(slope))
    assert by_window[:, :2] == pytest.approx(np.diag(slope))
    assert (by_window[:, 2:] == 0).all()


def test_operation_without_c_equivalent_raises_error():
    twist = ca.SX.sym("twist", 2)
    function = ca.Function("mine", [twist], [ca.erfinv(twist)], ["twist"], ["value"])
    with pytest.raises(ConfigError, match="erfinv"):
        generate([user_term(function, "t")], "user", "a test")


def test_function_with_external_calls_raises_error():
    twist = ca.MX.sym("twist", 2)
    table = ca.interpolant("table", "linear", [[0.0, 1.0]], [0.0, 2.0])
    with pytest.raises(ConfigError, match="term mine: .* use SX"):
        user_term(ca.Function("mine", [twist], [table(twist[0])], ["twist"], ["value"]), "t")
