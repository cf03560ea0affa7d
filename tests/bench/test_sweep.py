"""Settings as they are typed."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.bench.case import parse_seeds, split_names, split_numbers
from diffdrive_mpc.bench.sweep import sweep_settings
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc.config.typed_settings import parse_setting, single_settings


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("horizon=5", [5]),
        ("horizon=5,10, 20", [5, 10, 20]),
        ("weights.across=1.5,2", [1.5, 2]),
        ("solver.tolerance=1e-5,1E-4", [1e-5, 1e-4]),
        ("failure.resume=true,false", [True, False]),
        ("extra_dead_time.provenance=step test", ["step test"]),
    ],
)
def test_values_have_their_yaml_types(text: str, values: list[object]) -> None:
    key, parsed = parse_setting(text)
    assert key == text.partition("=")[0]
    assert parsed == values
    assert [type(value) for value in parsed] == [type(value) for value in values]


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=5))
def test_every_finite_number_is_read_exactly(numbers: list[float]) -> None:
    assert parse_setting("key=" + ",".join(repr(number) for number in numbers))[1] == numbers


def test_several_settings_make_every_combination_in_order() -> None:
    assert sweep_settings(["a=1,2", "b=x,y"]) == [
        (("a", 1), ("b", "x")),
        (("a", 1), ("b", "y")),
        (("a", 2), ("b", "x")),
        (("a", 2), ("b", "y")),
    ]
    assert sweep_settings([]) == [()]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("horizon", "write KEY=VALUE"),
        ("=5", "write KEY=VALUE"),
        ("horizon=", "write KEY=VALUE"),
        ("horizon=[5", "cannot be read"),
        ("horizon=5,5", "listed twice"),
        ("model=ssm", "--models"),
        ("limits={v: 0.1},{v: 0.2}", "dotted keys"),
        ("horizon=#5", "cannot be read"),
    ],
)
def test_what_cannot_be_a_setting_is_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        sweep_settings([text])


def test_a_key_given_twice_is_refused() -> None:
    with pytest.raises(ConfigError, match="given twice"):
        sweep_settings(["horizon=5", "horizon=10"])
    with pytest.raises(ConfigError, match="given twice"):
        sweep_settings(["limits.predicted_v=1", "expert.limits.predicted_v=0.5"])


def test_one_run_takes_one_value_for_each_key() -> None:
    assert single_settings(["horizon=5", "weights.along=2"]) == (("horizon", 5), ("weights.along", 2))
    with pytest.raises(ConfigError, match="use 'bench'"):
        single_settings(["horizon=5,10"])


@pytest.mark.parametrize("text", ["0", "-1", "1,1", "a", "1.5", "", ","])
def test_what_cannot_be_seeds_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="--seeds"):
        parse_seeds(text)


def test_lists_of_names_and_numbers() -> None:
    assert split_names("ssm, sm", "--models") == ("ssm", "sm")
    assert split_numbers("5,10", "--horizons", least=1) == (5, 10)
    with pytest.raises(ValueError, match="--models"):
        split_names("ssm,,sm", "--models")
    with pytest.raises(ValueError, match="at least 1"):
        split_numbers("0,5", "--horizons", least=1)
