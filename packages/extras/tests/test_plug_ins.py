"""What is registered is found, and what it names is there."""

from diffdrive_mpc.app.command_line.options import PluggedCommand
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
    assert all(isinstance(one, PluggedCommand) for one in plug_ins("commands"))
    assert all(isinstance(one, FileKind) for one in plug_ins("files"))
