"""Texts of files and messages cannot control the terminal through errors, warnings or results of the Python API."""

import random
import warnings

import pytest
import yaml
from log_parts import bag_topics, drive, write_bag, write_csv, write_mapping

from diffdrive_mpc import Controller, ModelError, load_config, load_model, load_trajectory
from diffdrive_mpc.models.errors import DiffdriveMpcError, NoteWarning
from diffdrive_mpc.models.load import model_path
from diffdrive_mpc.models.logs.reading import read_log
from diffdrive_mpc.models.logs.record import Finding

CONTROLS = ["\x1b[2J", "\x1b]0;owned\x07", "\r", "\n", "\x9b31m", "\u202e", "\u2066", "\u2028", "\x00", "\x7f", "\x85"]
NAMES = [
    "".join(random.Random(seed).sample(CONTROLS, 3)) + "x".join(random.Random(seed + 1).sample(CONTROLS, 2))
    for seed in range(12)
]


def refusal_message(call):
    with pytest.raises((DiffdriveMpcError, ValueError)) as error:
        call()
    assert str(error.value).isprintable(), str(error.value)
    return str(error.value)


@pytest.mark.parametrize("name", NAMES)
def test_errors_show_escapes_of_names(name, tmp_path):
    for error_type in {*_subclasses(DiffdriveMpcError)} - {
        cls for cls in _subclasses(DiffdriveMpcError) if "__init__" in vars(cls)
    }:
        assert str(error_type(f"odd{name}")).isprintable()
    with pytest.warns(NoteWarning) as caught_warnings:
        warnings.warn(NoteWarning(f"a{name}"), stacklevel=1)
    assert str(caught_warnings[0].message).isprintable()
    assert str(Finding("gap", "note", f"a{name}", name)).isprintable()
    file = tmp_path / "file.yaml"
    for load in (load_config, load_model, load_trajectory):
        file.write_text(yaml.safe_dump({f"key{name}": name, "name": name}))
        refusal_message(lambda load=load: load(file))
        refusal_message(lambda load=load: load(name))
        refusal_message(lambda load=load: load(tmp_path / name.replace("\x00", "")))
    refusal_message(lambda: load_config("ssm", {name: 1}))


@pytest.mark.parametrize("name", NAMES[:4])
def test_logs_show_escapes_of_columns_and_topics(name, tmp_path):
    text = f"\x1b{name}".translate(dict.fromkeys(map(ord, "\x00\n\r\u2028\x85;")))
    columns = drive(seconds=6.0)
    log = write_csv(tmp_path / "log.csv", {f"{key}{text}": values for key, values in columns.items()})
    assert "\\" in refusal_message(lambda: read_log(log, write_mapping(tmp_path / "map.yaml")))
    topics = {f"{key}{text}": rows for key, rows in bag_topics(columns).items()}
    assert "\\" in refusal_message(lambda: read_log(write_bag(tmp_path / "bag", topics)))


def test_results_show_escapes_of_names(tmp_path):
    name = "odd\x1b[2J\u202e"
    data = yaml.safe_load(model_path("ssm").read_text(encoding="utf-8")) | {"name": name}
    (tmp_path / "model.yaml").write_text(yaml.safe_dump(data))
    model = load_model(tmp_path / "model.yaml")
    controller = Controller(load_config("ssm"), model=model)
    for text in (repr(model), repr(controller)):
        assert r"odd\x1b[2J\u202e" in text
        assert text.isprintable()


def _subclasses(base):
    for subclass in base.__subclasses__():
        yield subclass
        yield from _subclasses(subclass)


def test_long_messages_are_truncated():
    assert len(str(ModelError("x" * 10_000))) == 4000
