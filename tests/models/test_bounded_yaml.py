"""Hostile and broken YAML: one line and nothing built, whatever it is."""

import contextlib
import os

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.models.checked_yaml import DEEPEST, ConfigError, parse_yaml, read_yaml
from diffdrive_mpc.mpc.config.config_file import load_config
from diffdrive_mpc.mpc.config.typed_settings import parse_setting

BOMB = "\n".join(["a0: &a0 [x, x]"] + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 30)])
UNFIT = [
    "!!bool z",
    "a: !!int ''",
    "!!float x",
    "!!timestamp q",
    "!!set [1]",
    "!!binary zzz",
    "2020-13-40",
    "? {a: 1}\n: 2",
]


@pytest.mark.parametrize("text", UNFIT)
def test_a_value_that_does_not_fit_its_type_is_one_line(text, tmp_path):
    file = tmp_path / "bad.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        read_yaml(file)
    assert str(caught.value).startswith(str(file))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[" * 3_000, "levels"),
        ("a: " + "[" * 300_000 + "]" * 300_000, "levels"),
        ("".join(" " * i + "a:\n" for i in range(200)), "levels"),
        ("- " * 10_000 + "1", "levels"),
        (BOMB, "values"),
        ("&a [*a]", "refers to what it stands in"),
        ("a: &a {b: {c: *a}}", "refers to what it stands in"),
    ],
)
def test_depth_aliases_and_circles_are_bounded(text, problem):
    with pytest.raises(yaml.MarkedYAMLError, match=problem):
        parse_yaml(text)


def test_aliases_count_for_the_depth_as_well():
    text = "".join(f"a{i}: &a{i} [{f'*a{i - 1}' if i else 1}]\n" for i in range(DEEPEST + 5))
    with pytest.raises(yaml.MarkedYAMLError, match="levels"):
        parse_yaml(text)


plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text(st.characters(categories=["L", "N"])),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(st.characters(categories=["L"]), min_size=1), inner),
    max_leaves=30,
)


@given(plain)
def test_what_is_written_is_read(data):
    assert parse_yaml(yaml.safe_dump(data)) == data


@given(st.text(max_size=60) | st.text("[]{}&*!:-? \nab1'\"|>%#", max_size=60))
def test_any_text_is_read_or_refused(text):
    with contextlib.suppress(yaml.YAMLError):
        parse_yaml(text)


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_only_files_on_a_disk_are_read(kind, tmp_path):
    path = tmp_path / "there.yaml"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    with pytest.raises(ConfigError, match="pipe or a device" if kind != "folder" else "directory"):
        read_yaml(path)


def test_a_large_file_is_refused(tmp_path):
    path = tmp_path / "large.yaml"
    with path.open("wb") as file:
        file.truncate(60_000_000)
    with pytest.raises(ConfigError, match="larger than 50 MB"):
        read_yaml(path)


def test_a_setting_whose_value_does_not_fit_is_one_line():
    with pytest.raises(ConfigError, match="cannot be read as values"):
        parse_setting("horizon=!!bool z")


def test_a_message_repeats_no_more_of_a_value_or_a_key_than_shows_what_it_is(tmp_path):
    file = tmp_path / "long.yaml"
    for text in (f"horizon: {'a' * 5000}\n", f"{'k' * 100_000}: 1\n", f'weights: {{along: "\\e[31m{"b" * 5000}"}}\n'):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(ConfigError) as caught:
            load_config(str(file))
        assert len(str(caught.value)) < 600
        assert "\x1b" not in str(caught.value)
