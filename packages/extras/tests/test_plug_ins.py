"""What is registered is found, and what it names is there."""

from importlib.metadata import EntryPoint

import pytest

from diffdrive_mpc.app.command_line.options import PluggedCommand
from diffdrive_mpc.models import plug_ins as registry
from diffdrive_mpc.models.file_kind import FileKind
from diffdrive_mpc.models.function_structure import function_structures
from diffdrive_mpc.models.plug_ins import plug_ins


def test_every_structure_names_what_is_there():
    ranks = [one.rank for one in function_structures().values()]
    assert list(function_structures()) == ["drive_physical", "drive_experimental", "hybrid", "lstm"]
    assert ranks == sorted(ranks)
    for one in function_structures().values():
        assert one.structure in str(one.schema().model_json_schema())
        assert callable(one.finder())
        assert one.shipped is None or one.shipped.is_file()


def test_commands_and_files_are_of_their_kind():
    assert [one.name for one in plug_ins("commands")] == ["plan", "torque"]
    assert all(isinstance(one, PluggedCommand) for one in plug_ins("commands"))
    assert all(isinstance(one, FileKind) for one in plug_ins("files"))


@pytest.fixture
def registered(monkeypatch):
    """Registers one place as the only plug-in."""

    def register(place):
        entry = EntryPoint("mine", place, "diffdrive_mpc.structures")
        monkeypatch.setattr(registry, "entry_points", lambda group: [entry])
        return registry.plug_ins.__wrapped__("structures")

    return register


def test_a_package_that_is_gone_is_left_out_and_one_that_is_broken_says_so(registered, tmp_path, monkeypatch):
    assert registered("a_package_of_nobody.plug_in:MINE") == ()
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "broken_plug_in.py").write_text("import a_module_of_nobody\n")
    with pytest.raises(ModuleNotFoundError, match="a_module_of_nobody"):
        registered("broken_plug_in:MINE")
    (tmp_path / "whole_plug_in.py").write_text("MINE = 7\n")
    assert registered("whole_plug_in:MINE") == (7,)
