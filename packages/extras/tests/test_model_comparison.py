"""Kinds of model side by side: what is known to be enough is recommended, and what is known to matter is found."""

import numpy as np
import pytest
from base_effect_parts import record_of
from identification_parts import data_of, noisy_drive, published_ssm, two_channels

from commands import invoke
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.base_effects import BaseEffects, TwistSlew
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.structures import ssm
from diffdrive_mpc_extras.model_comparison.model_comparison import NO_MODEL, ModelComparison, Scored, compare_models


@pytest.fixture(autouse=True)
def no_fifth_order(monkeypatch):
    """No model here has more than four states, and a fifth takes long: `identify --structure ssm` tries it."""
    monkeypatch.setattr(ssm, "LARGEST_ORDER", 4)


@pytest.mark.long
def test_two_decoupled_channels_are_an_sm_and_nothing_more():
    truth = two_channels((0.95, 14.0, 0.9), (0.6, 18.0, 1.0))
    comparison = compare_models(data_of(*(noisy_drive(truth, seed, 700) for seed in (1, 2))), ["sm", "ssm"], parts=2)
    assert comparison.recommended.kind == "sm"
    assert [score.kind for score in comparison.scores] == [NO_MODEL, "sm", "ssm"]
    low, high = comparison.gain(comparison.scores[2], comparison.recommended)
    assert low <= 0.0
    assert high < 1.0
    assert comparison.gain(comparison.scores[0], comparison.recommended)[1] < -5.0
    assert comparison.sentence().startswith("sm: ssm is ")


@pytest.mark.long
def test_channels_that_disturb_each_other_are_an_ssm(monkeypatch):
    """The published model of order 2, its cross terms ten times as large: to each command both speeds answer."""
    monkeypatch.setattr(ssm, "LARGEST_ORDER", 2)
    model = published_ssm()
    model.C[0, 1], model.C[1, 0] = 10 * model.C[0, 1], 10 * model.C[1, 0]
    comparison = compare_models(
        data_of(*(noisy_drive(model, seed, 700, noise=(0.003, 0.01)) for seed in (1, 2))), ["sm", "ssm"], parts=2
    )
    assert comparison.recommended.kind == "ssm"


@pytest.mark.long
def test_a_base_that_limits_slopes_is_an_sm_with_effects():
    effects = BaseEffects(twist_slew=TwistSlew(v=0.8, omega=1.5))
    records = [record_of(effects, seed, 30.0, noise=0.3) for seed in (1, 2)]
    comparison = compare_models(data_of(*records), ["sm", "sm+effects"], parts=2)
    assert comparison.recommended.kind == "sm+effects"
    assert "sm is worse by" in comparison.sentence()


def scored(kind, powers, failure=""):
    return Scored(kind, 2, np.asarray(powers, dtype=float), float("nan"), 1.0, failure)


def test_the_interval_is_that_of_the_blocks():
    """A gain that is the same in every block is certain; one that comes from a single block is not."""
    count = 40
    weights, spread = np.full((count, 2), 100.0), np.ones(2)
    base = scored("sm", np.full((count, 2), 0.04))
    everywhere = scored("ssm", np.full((count, 2), 0.03))
    once = np.full((count, 2), 0.0402)
    once[7] = 0.0
    by_one = scored("mbm", once)
    broken = scored("sm+effects", np.empty((0, 2)), "too few rows")
    comparison = ModelComparison((base, everywhere, by_one, broken), weights, spread, 2, 5.0)
    assert comparison.fits(base) == pytest.approx([80.0, 80.0])
    assert comparison.gain(everywhere, base) == pytest.approx(2 * [100 * (0.2 - np.sqrt(0.03))])
    low, high = comparison.gain(by_one, base)
    assert low < 0.0 < high
    assert comparison.recommended is everywhere
    assert "sm+effects was not found: too few rows" in comparison.sentence()
    assert [row[0] for row in comparison.table().rows] == ["sm", "ssm *", "mbm", "sm+effects"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [((["sm", "sms"], 3), "kind 'sms': give some of sm, ssm"), (((), 1), "parts = 1: give 2 or more")],
)
def test_impossible_comparison_is_refused(arguments, message):
    data = data_of(*(noisy_drive(published_ssm(), seed, 300) for seed in (1, 2)))
    with pytest.raises(ConfigError, match=message):
        compare_models(data, *arguments)


def test_the_command_prints_table_and_recommendation(tmp_path, monkeypatch):
    monkeypatch.setattr(ssm, "LARGEST_ORDER", 2)
    log = tmp_path / "drive.csv"
    invoke(app, "simulate", "--plant", "model:sm", "--model", "sm", "--trajectory", "slalom", "--log", log)
    result = invoke(app, "models", "compare", log, "--kinds", "sm,ssm", "--parts", "2")
    assert "sm *" in result.output and "ssm is " in result.output
    rows = [line.split(":")[0] for line in result.stderr.splitlines() if "found in" in line]
    assert rows == ["sm", "ssm"]
