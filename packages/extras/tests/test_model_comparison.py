"""`diffdrive-mpc models compare`: recommendations for robots with known dynamics, intervals and errors."""

import numpy as np
import pytest
from base_effect_parts import record_of
from identification_parts import data_of, noisy_drive, published_ssm, two_channels

from commands import invoke
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.base_effects import BaseEffects, TwistSlew
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.structures import ssm
from diffdrive_mpc_extras.model_comparison.model_comparison import NO_MODEL, KindScore, ModelComparison, compare_models


@pytest.fixture(autouse=True)
def limit_order(monkeypatch):
    """Limit the order of the SSM to 4: the true models have at most four states, and higher orders take long."""
    monkeypatch.setattr(ssm, "MAX_ORDER", 4)


@pytest.mark.long
def test_sm_is_recommended_for_decoupled_channels():
    model = two_channels((0.95, 14.0, 0.9), (0.6, 18.0, 1.0))
    comparison = compare_models(data_of(*(noisy_drive(model, seed, 700) for seed in (1, 2))), ["sm", "ssm"], parts=2)
    assert comparison.recommended.kind == "sm"
    assert [score.kind for score in comparison.scores] == [NO_MODEL, "sm", "ssm"]
    low, high = comparison.gain(comparison.scores[2], comparison.recommended)
    assert low <= 0.0
    assert high < 1.0
    assert comparison.gain(comparison.scores[0], comparison.recommended)[1] < -5.0
    assert comparison.sentence().startswith("sm: ssm is ")


@pytest.mark.long
def test_ssm_is_recommended_for_coupled_channels(monkeypatch):
    """Drive the published model of order 2 with cross terms ten times as large."""
    monkeypatch.setattr(ssm, "MAX_ORDER", 2)
    model = published_ssm()
    model.C[0, 1], model.C[1, 0] = 10 * model.C[0, 1], 10 * model.C[1, 0]
    comparison = compare_models(
        data_of(*(noisy_drive(model, seed, 700, noise=(0.003, 0.01)) for seed in (1, 2))), ["sm", "ssm"], parts=2
    )
    assert comparison.recommended.kind == "ssm"


@pytest.mark.long
def test_sm_with_effects_is_recommended_for_a_base_with_slew_limits():
    effects = BaseEffects(twist_slew=TwistSlew(v=0.8, omega=1.5))
    records = [record_of(effects, seed, 30.0, noise=0.3) for seed in (1, 2)]
    comparison = compare_models(data_of(*records), ["sm", "sm+effects"], parts=2)
    assert comparison.recommended.kind == "sm+effects"
    assert "sm is worse by" in comparison.sentence()


def make_score(kind, powers, failure=""):
    return KindScore(kind, 2, np.asarray(powers, dtype=float), float("nan"), 1.0, failure)


def test_interval_of_the_gain_depends_on_the_variation_between_blocks():
    """A constant gain has no uncertainty; a gain from a single block is not significant."""
    count = 40
    weights, spread = np.full((count, 2), 100.0), np.ones(2)
    base = make_score("sm", np.full((count, 2), 0.04))
    constant_gain = make_score("ssm", np.full((count, 2), 0.03))
    powers = np.full((count, 2), 0.0402)
    powers[7] = 0.0
    single_block = make_score("mbm", powers)
    failed = make_score("sm+effects", np.empty((0, 2)), "too few rows")
    comparison = ModelComparison((base, constant_gain, single_block, failed), weights, spread, 2, 5.0)
    assert comparison.fits(base) == pytest.approx([80.0, 80.0])
    assert comparison.gain(constant_gain, base) == pytest.approx(2 * [100 * (0.2 - np.sqrt(0.03))])
    low, high = comparison.gain(single_block, base)
    assert low < 0.0 < high
    assert comparison.recommended is constant_gain
    assert "sm+effects was not identified: too few rows" in comparison.sentence()
    assert [row[0] for row in comparison.table().rows] == ["sm", "ssm *", "mbm", "sm+effects"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [((["sm", "sms"], 3), "kind 'sms': give names from sm, ssm"), (((), 1), "parts = 1: give 2 or more")],
)
def test_invalid_arguments_raise_config_error(arguments, message):
    data = data_of(*(noisy_drive(published_ssm(), seed, 300) for seed in (1, 2)))
    with pytest.raises(ConfigError, match=message):
        compare_models(data, *arguments)


def test_command_prints_scores_table_and_recommendation(tmp_path, monkeypatch):
    monkeypatch.setattr(ssm, "MAX_ORDER", 2)
    log = tmp_path / "drive.csv"
    invoke(app, "simulate", "--plant", "model:sm", "--model", "sm", "--trajectory", "slalom", "--log", log)
    result = invoke(app, "models", "compare", log, "--kinds", "sm,ssm", "--parts", "2")
    assert "sm *" in result.output and "ssm is " in result.output
    rows = [line.split(":")[0] for line in result.stderr.splitlines() if "identified in" in line]
    assert rows == ["sm", "ssm"]
