"""Hostile YAML, names and paths: each gives one line, and no object is built and no code runs."""

import contextlib
import os
from pathlib import Path
from unittest.mock import Mock

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic_core import SchemaError

from diffdrive_mpc.models.checked_yaml import ConfigError, check, parse_yaml, read_yaml
from diffdrive_mpc.models.identification.deliver.configuration import IdentifiedConfiguration, Setting
from diffdrive_mpc.models.logs.mapping import LogMapping
from diffdrive_mpc.models.named_file import named_file, shipped_names
from diffdrive_mpc.models.table import plain_line
from diffdrive_mpc.mpc.config.config_file import load_config

yaml_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text(st.characters(categories=["L", "N"])),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(st.characters(categories=["L"]), min_size=1), inner),
    max_leaves=30,
)


@given(yaml_values)
def test_parsed_data_equal_the_written_data(data):
    assert parse_yaml(yaml.safe_dump(data)) == data


@given(st.text(max_size=60) | st.text("[]{}&*!:-? \nab1'\"|>%#", max_size=60))
def test_any_text_is_read_or_refused(text):
    with contextlib.suppress(yaml.YAMLError):
        parse_yaml(text)


DEVICE = "pipe or a device"


@pytest.mark.parametrize(
    ("create", "message"),
    [(os.mkfifo, DEVICE), (lambda path: path.symlink_to("/dev/zero"), DEVICE), (Path.mkdir, "directory")],
)
def test_only_regular_files_are_read(create, message, tmp_path):
    create(tmp_path / "there.yaml")
    with pytest.raises(ConfigError, match=message):
        read_yaml(tmp_path / "there.yaml")


def test_message_shortens_long_values_and_keys(tmp_path):
    file = tmp_path / "long.yaml"
    for text in (f"horizon: {'a' * 5000}\n", f"{'k' * 100_000}: 1\n", f'weights: {{along: "\\e[31m{"b" * 5000}"}}\n'):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(ConfigError) as error:
            load_config(str(file))
        assert len(str(error.value)) < 600
        assert "\x1b" not in str(error.value)


@given(st.text())
def test_any_text_becomes_one_printable_line(text):
    line = plain_line(text, max_length=60)
    assert line.isprintable()
    assert len(line) <= 60
    assert len(line.splitlines()) <= 1


@given(st.text(st.characters(categories=["L", "N", "P", "S"]), max_size=60))
def test_harmless_text_is_unchanged(text):
    assert plain_line(text) == text


@given(st.text())
def test_name_adds_no_key_to_a_configuration(name):
    configuration = IdentifiedConfiguration(
        name, (Setting("sample_time", 0.02, f"from {name}"),), {"limits": (), "wheels": (), "failure": ()}
    )
    assert set(yaml.safe_load(configuration.text())) == {"sample_time", "limits"}


def test_shipped_name_precedes_a_file_of_that_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shipped, local = tmp_path / "shipped", tmp_path / "own"
    for folder in (shipped, local):
        folder.mkdir()
    for name in ("wet", "dry", "notes"):
        (shipped / f"{name}.yaml").touch()
    (local / "wet").touch()
    (local / "mud").touch()
    monkeypatch.chdir(local)
    assert shipped_names(shipped) == ("dry", "notes", "wet")
    assert named_file("floor", shipped, "wet") == shipped / "wet.yaml"
    assert named_file("floor", shipped, "mud") == Path("mud")
    with pytest.raises(ConfigError, match=r"unknown floor 'notes': give one of dry, wet or the path of a floor file$"):
        named_file("floor", shipped, "notes", ("dry", "wet"))


def test_ctrl_c_during_schema_construction_raises_keyboard_interrupt(monkeypatch):
    for text, error in (('Field "sign":\n  KeyboardInterrupt: ', KeyboardInterrupt), ("no such type", SchemaError)):
        monkeypatch.setattr(LogMapping, "model_validate", Mock(side_effect=SchemaError(text)))
        with pytest.raises(error):
            check(LogMapping, {}, "x.yaml")
