"""docs/moved.md: what went where."""

import importlib
import re
from pathlib import Path

import pytest
import typer.main

from commands import invoke
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.mpc.config.fixed_values import fixed_values
from diffdrive_mpc.mpc.config.former_keys import former_keys
from diffdrive_mpc.mpc.config.rooms import shown_key
from studies.cli import app as studies_app

PAGE = (Path(__file__).parents[2] / "docs" / "moved.md").read_text(encoding="utf-8")
_ROW = re.compile(r"^\| `([^`]+)`([^|]*) \| `([^`]+)` \|$", re.MULTILINE)
_PLACES, _, _KEYS = PAGE.partition("## Keys of a configuration")
ROWS = _ROW.findall(_PLACES)
COMMANDS = [(before, now) for before, more, now in ROWS if " " in now and not more]
NAMES = [(before, now) for before, _, now in ROWS if " " not in now]


def found(command):
    """The command of those words, in the command line or among the studies."""
    words = command.removeprefix("diffdrive-mpc ").removeprefix("python -m studies ").split()
    group = typer.main.get_command(studies_app if command.startswith("python") else app)
    for word in words:
        if word.startswith("--"):
            return next(option for option in group.params if word in option.opts)
        group = group.commands[word]
    return group


@pytest.mark.parametrize(("before", "now"), COMMANDS)
def test_a_former_command_is_there_under_its_new_name_and_says_so(before, now):
    assert found(now)
    if now != before:
        said = invoke(app, *before.split()[1:], code=2)
        assert now in " ".join(said.output.split())


@pytest.mark.parametrize(("before", "now"), NAMES)
def test_a_name_is_where_the_page_says_and_no_longer_where_it_was(before, now):
    assert named(now) is not None
    with pytest.raises((ImportError, AttributeError)):
        named(before)


def named(dotted):
    """A module, or what a module or a class of it holds."""
    try:
        return importlib.import_module(dotted)
    except ImportError:
        home, _, name = dotted.rpartition(".")
        return getattr(named(home), name)


def test_the_page_names_every_key_that_has_another_name_now():
    assert {before: now for before, _, now in _ROW.findall(_KEYS)} == {
        old: f"fixed_values.yaml: {new}" if new in fixed_values() else shown_key(new)
        for old, new in former_keys().items()
    }
