"""Relevance of each kind of doubt for driving: one verdict for every kind."""

import ast
from pathlib import Path

import numpy as np
import pytest
from identification_parts import noisy_drive, two_channels

from diffdrive_mpc import models
from diffdrive_mpc.models.doubt import VERDICTS
from diffdrive_mpc.models.output_error.doubts import response_delays, uncertain_delays, uncertain_parameters
from diffdrive_mpc.models.output_error.experiment import twist_experiments
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.structures.channel import identify_channel

FOLDER = Path(models.__file__).parent
TRIALS = FOLDER.parent / "studies" / "shipped_models"


def kinds_in_the_sources() -> set[str]:
    """Collect the first words of every `Doubt(...)`, and of every `Finding(...)` above a note."""
    result = set()
    for path in (*FOLDER.rglob("*.py"), *TRIALS.glob("*.py")):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = getattr(getattr(call, "func", None), "id", "")
            if name not in ("Doubt", "Finding"):
                continue
            if name == "Finding" and getattr(call.args[1], "value", "") == "note":
                continue
            values = [part.value for part in ast.walk(call.args[0]) if isinstance(part, ast.Constant)]
            result |= {value for value in values if isinstance(value, str)}
    return result


def test_every_kind_has_a_verdict():
    kinds = kinds_in_the_sources()
    assert len(kinds) > 30
    assert kinds - set(VERDICTS) == set()


@pytest.mark.parametrize(("deviation", "expected"), [(0.005, []), (0.03, ["lag"])])
def test_only_the_total_delay_matters(deviation, expected):
    """The division of a delay of 0.07 s is unknown in both cases; only an uncertain total is a relevant doubt."""
    names = ("v.gain", "v.natural_frequency", "v.damping")
    estimate = ParameterEstimate(names, np.array([1.0, 100.0, 2.0]), np.diag([0.01, 80.0, 1.6]) ** 2)
    delays = ParameterEstimate(("v",), np.array([0.07]), np.array([[deviation**2]]))
    assert [doubt.kind for doubt in uncertain_parameters(estimate, delays=delays)] == ["divided lag", "divided lag"]
    assert [doubt.kind for doubt in uncertain_delays(delays)] == expected


def test_delay_of_a_fit_is_known_better_than_its_parts():
    """For a lag of 20 ms after 50 ms of dead time, steps at 50 Hz determine the sum much better than the parts."""
    lag = two_channels((1.0, 140.0, 1.4), (1.0, 7.0, 0.7), dead_time=(0.05, 0.03))
    fit = identify_channel(_channel(noisy_drive(lag, 8, count=400, noise=(0.03, 0.03))), "v", limit=False).fit
    delay = response_delays(fit, ["v"], [0])
    assert delay.value("v") == pytest.approx(0.07, abs=3 * delay.deviation("v"))
    dead_time = fit.estimate.deviation("dead_time_0")
    assert delay.deviation("v") < dead_time / 2


def test_uncertainty_of_a_fit_matters_only_if_relevant_for_driving():
    """Use one robot with a long log of low noise, and with a short log of noise as large as its speed."""
    lag = two_channels((1.0, 140.0, 1.4), (1.0, 7.0, 0.7), dead_time=(0.05, 0.03))
    quiet, noisy = (
        identify_channel(_channel(noisy_drive(lag, 8, count=count, noise=(noise, noise))), "v", limit=False).warnings
        for count, noise in ((3000, 0.01), (150, 1.0))
    )
    assert not [str(doubt) for doubt in quiet if doubt.verdict.matters]
    assert "v: dead time and lag" in " ".join(doubt.message for doubt in noisy if doubt.verdict.matters)


def _channel(drive):
    return [experiment.channel(0, 0) for experiment in twist_experiments([drive])]
