"""Input is never executed: contents of files, bags and messages are data, and their size is limited.

A reader is a command or function that reads external input. Each test input refers to code, and a file with that code
exists at the given path. The file must not be opened, no code may run, and the reader must end with one line.
"""

import json
import os
import pickle
import re
import sys
from functools import partial
from pathlib import Path

import pytest
import yaml
from mcap.writer import Writer
from typer.testing import CliRunner

from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.load import model_path
from diffdrive_mpc.models.logs.csv_table import read_table
from diffdrive_mpc.models.logs.drive_log.ros_messages import decode
from diffdrive_mpc.models.logs.tick_record import DriveRecord, TickRecord
from diffdrive_mpc.mpc.config.schema import ControllerConfig

ROOT = Path(__file__).parents[2]
TERM = "import pathlib\npathlib.Path(__file__).with_name('marker').mkdir()\n"

events: list[str] = []
observed = {"folder": "no folder"}
"""Folder of the untrusted code."""


def _record_event(event, arguments):
    if event == "pickle.find_class":
        events.append(f"{event} {arguments}")
    elif event == "import":
        if str(arguments[0]).startswith("stranger"):
            events.append(f"{event} {arguments[0]}")
    elif event in ("open", "os.mkdir", "os.system", "subprocess.Popen", "ctypes.dlopen") and observed["folder"] in str(
        arguments
    ):
        events.append(f"{event} {arguments}")


sys.addaudithook(_record_event)


class Payload:
    """Object that creates a folder when it is unpickled."""

    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder / "marker"),)


@pytest.fixture
def untrusted(tmp_path):
    """Folder of untrusted code; 'stranger_code' can be imported from it."""
    folder = tmp_path / "stranger"
    folder.mkdir()
    for name in ("term.py", "stranger_code.py", "code.so", "terms.c", "model.yaml"):
        (folder / name).write_text(TERM)
    (folder / "evil.npz").write_bytes(pickle.dumps(Payload(folder)))
    return folder


def call(*arguments):
    """Run a command; bad input must end in one line, without a traceback."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), (arguments, result.exception)
    assert result.exit_code in (0, 1, 2), (arguments, result.output)
    if result.exit_code == 2:
        assert "error: " in result.output, result.output
        assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f]", result.output)


# YAML files of all kinds; tags of PyYAML would create Python objects.

TAGS = (
    "!!python/object/apply:os.mkdir ['{}/marker']",
    "!!python/name:stranger_code.run",
    "!!python/module:stranger_code",
)
YAML = {
    "configuration": "config check FILE",
    "model": "models show FILE",
    "trajectory": "simulate --plant model:ssm --trajectory FILE",
    "plant": "simulate --plant mujoco:FILE",
    "surface": "simulate --surface FILE",
    "sensors": "simulate --sensors FILE",
    "scenario": "simulate --scenario FILE",
    "mapping": "identify LOG --mapping FILE --out OUT",
}


def _read_yaml(command, tag, untrusted, folder):
    (folder / "file.yaml").write_text(f"name: {tag.format(untrusted)}\n")
    (folder / "log.csv").write_text("t,v\n0,1\n")
    files = {"FILE": folder / "file.yaml", "OUT": folder / "out", "LOG": folder / "log.csv"}
    arguments = [re.sub("FILE|OUT|LOG", lambda match: str(files[match[0]]), argument) for argument in command.split()]
    call(*arguments)


# Other inputs. The arguments of each function are the folder with the code and the folder for the input file.


def _read_csv(untrusted, folder):
    cells = ["__import__('os').mkdir('@/marker')", "=cmd|' /C calc'!A0", "@/term.py", "!!python/name:os.mkdir"]
    rows = "".join(f'{i},"{cell}",0\n' for i, cell in enumerate(cells))
    (folder / "log.csv").write_text("t_s,v,omega\n" + rows.replace("@", str(untrusted)))
    call("identify", folder / "log.csv", "--out", folder / "out")
    with pytest.raises(ValueError, match=r"log\.csv"):
        read_table(folder / "log.csv", {"t_s", "v"}).numbers("v")


def _read_bag(untrusted, folder):
    """Write a bag with definitions that would inject code into generated types; the reader ignores them."""
    code = f"string X=\"'\\n__import__('os').mkdir('{untrusted}/marker')#\"\nfloat64 x\n__import__\n"
    with (folder / "bag.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema("geometry_msgs/msg/Twist", "ros2msg", code.encode())
        channel = writer.register_channel("/cmd_vel", "cdr", schema)
        for time in range(5):
            writer.add_message(channel, time, b"\0\1\0\0" + bytes(48), time)
        writer.add_attachment(0, 0, "term.py", "text/x-python", TERM.encode())
        writer.add_attachment(0, 0, f"{untrusted}/evil.pkl", "application/x-pickle", pickle.dumps(Payload(untrusted)))
        writer.add_metadata("configuration", {"yaml": f"model: {untrusted}/model.yaml"})
        writer.finish()
    call("identify", folder / "bag.mcap", "--out", folder / "out.png")
    call("log", "replay", folder / "bag.mcap")


def _read_bag_folder(untrusted, folder):
    for text in (
        f"rosbag2_bagfile_information: !!python/object/apply:os.mkdir ['{untrusted}/marker']\n",
        yaml.safe_dump({"rosbag2_bagfile_information": {"relative_file_paths": [f"{untrusted}/code.so"]}}),
    ):
        (folder / "metadata.yaml").write_text(text)
        call("identify", folder, "--out", folder / "out")


def _read_drive_log(untrusted, folder):
    """Write a log of a drive whose configuration names code; replay with another configuration ignores that code."""
    texts = [
        f"terms: [{{file: {untrusted}/term.py, function: run}}]",
        f"model: {untrusted}/model.yaml",
        f"solver: {{method: {untrusted}/code.so}}",
        f"name: !!python/object/apply:os.mkdir ['{untrusted}/marker']",
        "[1, 2]",
    ]
    for text in texts:
        with (folder / "log.mcap").open("wb") as file:
            writer = Writer(file)
            writer.start()
            schema = writer.register_schema("diffdrive_mpc.State", "jsonschema", b"{}")
            channel = writer.register_channel("/diffdrive_mpc/state", "json", schema)
            for time in range(3):
                row = {"t_s": 0.02 * time, "mode": f"\x1b[2J{untrusted}/term.py", "message": "!!python/name:os.mkdir"}
                writer.add_message(channel, time, json.dumps(row).encode(), time)
            writer.add_attachment(0, 0, "evil.pkl", "application/x-pickle", pickle.dumps(Payload(untrusted)))
            writer.add_metadata("configuration", {"yaml": text})
            writer.add_metadata("case", {"plant": f"mujoco:{untrusted}/model.yaml"})
            writer.finish()
        call("log", "replay", folder / "log.mcap")


def _read_ticks(untrusted, _):
    """Read tick records of a node; a bag may contain such records."""
    lines = [json.dumps({"format": 1, "py/object": "os.mkdir", "drive": f"{untrusted}/term.py"}), "[" * 100_000, "1"]
    for line in [*lines, pickle.dumps(Payload(untrusted)).decode("latin-1")]:
        for record_type in (TickRecord, DriveRecord):
            with pytest.raises(ValueError, match=r"not a record|not valid JSON|format"):
                record_type.read(line)


def _read_messages(untrusted, _):
    for message_type in ("std_msgs/msg/String", "nav_msgs/msg/Path", "trajectory_msgs/msg/MultiDOFJointTrajectory"):
        with pytest.raises(Exception):  # noqa: B017 - the library's own kinds
            decode(message_type, pickle.dumps(Payload(untrusted)))
    from diffdrive_mpc.mpc.ros.conversions import MessageError, check_frame
    from diffdrive_mpc.mpc.ros.parameters import fields

    with pytest.raises(MessageError, match=r"\\x1b\[2J"):
        check_frame("\x1b[2J", "odom", "odom_frame")
    # Parameters of a node cannot name code: lists, such as terms, come from files only.
    assert not [name for name, _ in fields(ControllerConfig) if name.startswith("terms")]


def _read_model(untrusted, folder):
    """Write a model whose structure is the name of a module or a file; only installed structures are permitted."""
    for structure in ("stranger_code:run", f"{untrusted}/term.py", f"{untrusted}/code.so", "os"):
        (folder / "model.yaml").write_text(yaml.safe_dump({"structure": structure, "name": "odd"}))
        call("models", "show", folder / "model.yaml")


READERS = {
    **{name: partial(_read_yaml, command, TAGS[0]) for name, command in YAML.items()},
    **{tag.split()[0]: partial(_read_yaml, YAML["model"], tag) for tag in TAGS[1:]},
    "a CSV log": _read_csv,
    "a bag and its attachments": _read_bag,
    "a folder of a bag": _read_bag_folder,
    "a log of a drive and its attachments": _read_drive_log,
    "records of ticks": _read_ticks,
    "messages of ROS": _read_messages,
    "a model file": _read_model,
}


@pytest.mark.parametrize("name", READERS)
def test_input_is_never_executed(name, untrusted, tmp_path, monkeypatch):
    folder = tmp_path / "door"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(untrusted))
    events.clear()
    monkeypatch.setitem(observed, "folder", f"{untrusted}/")
    READERS[name](untrusted, folder)
    assert not events
    assert not (untrusted / "marker").exists()
    assert "stranger_code" not in sys.modules


# Few files contain code that could execute a file; each has its reason.

EXECUTION = re.compile(
    r"yaml\.(?:load|full_load|unsafe_load)\(|(?:np|numpy)\.load\(|\bpickle\.loads?\(|\beval\(|(?<![\w.])exec\("
    r"|exec_module\(|CDLL\(|dlopen\(|\bexternal\(|\bjoblib\.load\(|\bshelve\.|run_path\(|allow_pickle=True"
)
EXECUTING_FILES = {
    "models/checked_yaml.py": "safe loader, within bounds",
    "models/compiled/packaged.py": "compiled C of the package, or of the user's own cache",
    "models/logs/drive_log/recorder.py": "a socket between this process and its child",
    "mpc/core/library.py": "likewise, with terms that the user's configuration names",
    "mpc/problem/terms.py": "the file of a term, if it is trusted",
    "sim/core/library.py": "compiled C of the package",
}


def test_only_listed_files_could_execute_a_file():
    files = {
        str(path.relative_to(ROOT))
        for package in ("app", "bench", "models", "mpc", "sim", "src")
        for path in (ROOT / package).rglob("*.py")
        if EXECUTION.search(path.read_text(encoding="utf-8"))
    }
    assert files == set(EXECUTING_FILES)


def test_escape_sequences_of_names_are_printed_as_text(tmp_path):
    data = yaml.safe_load(model_path("ssm").read_text(encoding="utf-8"))
    data["name"] = "odd\x1b[2J\x07\u202e"
    data["provenance"]["notes"] = "a note\x1b]0;owned\x07"
    (tmp_path / "odd.yaml").write_text(yaml.safe_dump(data))
    for arguments in (["models", "show"], ["models", "check"]):
        output = CliRunner().invoke(app, [*arguments, str(tmp_path / "odd.yaml")], color=True).output
        assert r"odd\x1b[2J" in output
        assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f\u202e]", output)
