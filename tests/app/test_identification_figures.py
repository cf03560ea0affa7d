"""The figure of measured beside simulated shows all that was held out."""

from types import SimpleNamespace

import numpy as np
import pytest

from diffdrive_mpc.app.identification.figures import draw_simulation, envelope, simulation_charts
from diffdrive_mpc.models.identification.log_data import LogData
from diffdrive_mpc.models.logs import Record


def report_of(lengths, dt=0.05):
    """Of stretches whose simulation is their command, with one reading that leaps in each."""
    rng = np.random.default_rng(0)
    records = []
    for k, count in enumerate(lengths):
        command = np.repeat(rng.uniform(-1.0, 1.0, (-(-count // 20), 2)), 20, axis=0)[:count]
        twist = command.copy()
        twist[count // 3] = 5.0 + k
        records.append(Record(f"part {k}", 100.0 * k, dt, command, twist))
    data = LogData((), tuple(records), ("made up",), "nothing", "encoders", (), ())
    validation = SimpleNamespace(fit_percent=np.array([90.0, 80.0]))
    fitted = SimpleNamespace(simulated=[record.command for record in records], validation=validation, predictor=None)
    return SimpleNamespace(data=data, fitted=fitted, name="made up")


@pytest.mark.parametrize("lengths", [(160,), (160,) * 30, (20_000, 160)])
def test_every_stretch_held_out_is_shown_with_its_extremes(tmp_path, lengths):
    report = report_of(lengths)
    for chart in simulation_charts(report):
        command, measured, simulated = chart.series
        assert simulated.x[-1] == pytest.approx(0.05 * sum(lengths), abs=0.1)
        assert {5.0 + k for k in range(len(lengths))} <= set(measured.y)
        assert max(len(series.x) for series in chart.series) <= 1500 + len(lengths) + 2
        assert simulated.y.count(None) == len(lengths)
        assert set(command.y) == set(simulated.y)
    draw_simulation(report, tmp_path / "simulation.png")
    assert (tmp_path / "simulation.png").stat().st_size > 10_000


def test_an_envelope_keeps_extremes_and_gaps():
    values = np.sin(np.linspace(0.0, 20.0, 10_000))
    values[3000], values[7000], values[5000] = 9.0, -9.0, np.nan
    rows = envelope(values, 100)
    assert {3000, 5000, 7000} <= set(rows) and len(rows) <= 103
    assert list(envelope(values[:50], 100)) == list(range(50))
