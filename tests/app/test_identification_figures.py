"""The figure of measured beside simulated shows all that was held out."""

import numpy as np

from diffdrive_mpc.app.identification.figures import envelope


def test_an_envelope_keeps_extremes_and_gaps():
    values = np.sin(np.linspace(0.0, 20.0, 10_000))
    values[3000], values[7000], values[5000] = 9.0, -9.0, np.nan
    rows = envelope(values, 100)
    assert {3000, 5000, 7000} <= set(rows) and len(rows) <= 103
    assert list(envelope(values[:50], 100)) == list(range(50))
