"""The shipped SSM against the transfer functions printed in the paper."""

import control
import numpy as np
import pytest

from diffdrive_mpc.models import load_model

# Guffanti, Pavon, Sensors 2025, 25(18), 5821: numerators (s, 1) over the common denominator, as printed: without
# minus signs, and with the two cross terms under each other's names.
PRINTED = {
    (0, 0): (7.428, 98.86),
    (1, 1): (14.26, 105.9),
    (0, 1): (0.1981, 0.01966),
    (1, 0): (1.013, 0.9052),
}
PRINTED_DENOMINATOR = (1.0, 20.69, 98.62)
PRINTED_DIGITS = 4


def coefficients(A, B, C):
    """Numerators by (output, input), and the denominator."""
    numerators = {}
    for output, channel in PRINTED:
        tf = control.ss2tf(control.ss(A, B[:, [channel]], C[[output]], 0))
        num = np.atleast_1d(tf.num[0][0])
        numerators[output, channel] = np.pad(num, (3 - len(num), 0))[-2:]
        denominator = tf.den[0][0]
    return numerators, denominator


def half_digit(values):
    """Half a unit in the last of the printed significant digits."""
    values = np.abs(np.asarray(values, dtype=float))
    return 0.5 * 10.0 ** (np.floor(np.log10(values)) - PRINTED_DIGITS + 1)


def rounding_bounds(model):
    """How far the coefficients can move when every matrix entry moves by half its last printed digit."""
    nominal, nominal_den = coefficients(model.A, model.B, model.C)
    bounds = {key: np.zeros(2) for key in nominal}
    den_bound = np.zeros(3)
    for name in "ABC":
        matrix = getattr(model, name)
        for index, step in np.ndenumerate(half_digit(matrix)):
            moved = {other: getattr(model, other).copy() for other in "ABC"}
            moved[name][index] += step
            numerators, denominator = coefficients(moved["A"], moved["B"], moved["C"])
            for key in bounds:
                bounds[key] += np.abs(numerators[key] - nominal[key])
            den_bound += np.abs(denominator - nominal_den)
    return nominal, nominal_den, bounds, den_bound


def test_transfer_functions_agree_to_the_rounding_of_the_matrices():
    nominal, denominator, bounds, den_bound = rounding_bounds(load_model("ssm"))
    for key, printed in PRINTED.items():
        allowed = bounds[key] + half_digit(printed)
        assert (np.abs(np.abs(nominal[key]) - printed) <= allowed).all(), (key, nominal[key], printed, allowed)
    assert (np.abs(denominator - PRINTED_DENOMINATOR)[1:] <= (den_bound + [0, 0.005, 0.005])[1:]).all()


def test_the_bounds_are_tight_enough_to_notice_a_lost_sign():
    model = load_model("ssm")
    A = model.A.copy()
    A[1, 0] = -A[1, 0]
    nominal, _ = coefficients(A, model.B, model.C)
    _, _, bounds, _ = rounding_bounds(model)
    misfit = max(
        float((np.abs(np.abs(nominal[key]) - printed) / (bounds[key] + half_digit(printed))).max())
        for key, printed in PRINTED.items()
    )
    assert misfit > 10


def test_poles_gains_and_lags():
    model = load_model("ssm")
    assert np.sort(model.poles) == pytest.approx([-13.25, -7.44], abs=0.01)
    assert model.dc_gain == pytest.approx(np.array([[1.0026, -0.0002], [0.0092, 1.073]]), abs=5e-4)
    assert model.lag == pytest.approx([0.135, 0.075], abs=5e-4)
    assert (model.dead_time == 0).all()
