"""No door executes what a file says: what comes from files, bags and messages is data, and has bounds.

A door is a command or a function that reads something from elsewhere. Each gets input that names code, and a file of
code lies where the input points to. That file must not be opened, nothing may run, and the door ends in one line.
"""

import hashlib
import io
import json
import os
import pickle
import re
import subprocess
import sys
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.writer import Writer
from typer.testing import CliRunner

from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.load import model_path
from diffdrive_mpc.models.logs.csv_table import read_table
from diffdrive_mpc.models.logs.drive_log.ros_messages import decoded
from diffdrive_mpc.models.logs.tick_record import DriveRecord, TickRecord
from diffdrive_mpc.mpc.config.schema import ControllerConfig

ROOT = Path(__file__).parents[2]
NETWORK = model_path("lstm")
TERM = "import pathlib\npathlib.Path(__file__).with_name('marker').mkdir()\n"

events: list[str] = []
watched = {"folder": "no folder"}
"""Folder of the code."""


def _note(event, arguments):
    if event == "pickle.find_class":
        events.append(f"{event} {arguments}")
    elif event == "import":
        if str(arguments[0]).startswith("stranger"):
            events.append(f"{event} {arguments[0]}")
    elif event in ("open", "os.mkdir", "os.system", "subprocess.Popen", "ctypes.dlopen") and watched["folder"] in str(
        arguments
    ):
        events.append(f"{event} {arguments}")


sys.addaudithook(_note)


class Reduced:
    """Unpickled, it makes a folder."""

    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder / "marker"),)


@pytest.fixture
def stranger(tmp_path):
    """A folder of code that nobody has looked at; 'stranger_code' could be imported."""
    folder = tmp_path / "stranger"
    folder.mkdir()
    for name in ("term.py", "stranger_code.py", "code.so", "terms.c", "model.yaml"):
        (folder / name).write_text(TERM)
    (folder / "evil.npz").write_bytes(pickle.dumps(Reduced(folder)))
    return folder


def call(*words):
    """Run a command; bad input must end in one line, without a traceback."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exception is None or isinstance(result.exception, SystemExit), (words, result.exception)
    assert result.exit_code in (0, 1, 2), (words, result.output)
    if result.exit_code == 2:
        assert "error: " in result.output, result.output
        assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f]", result.output)


# YAML of every kind: tags of PyYAML make objects of Python.

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


def _yaml(command, tag, stranger, door):
    (door / "file.yaml").write_text(f"name: {tag.format(stranger)}\n")
    (door / "log.csv").write_text("t,v\n0,1\n")
    places = {"FILE": door / "file.yaml", "OUT": door / "out", "LOG": door / "log.csv"}
    words = [re.sub("FILE|OUT|LOG", lambda match: str(places[match[0]]), word) for word in command.split()]
    call(*words)


# Everything else. Each row is a function of the folder of code and of one for the file at the door.


def _csv(stranger, door):
    cells = ["__import__('os').mkdir('@/marker')", "=cmd|' /C calc'!A0", "@/term.py", "!!python/name:os.mkdir"]
    rows = "".join(f'{i},"{cell}",0\n' for i, cell in enumerate(cells))
    (door / "log.csv").write_text("t_s,v,omega\n" + rows.replace("@", str(stranger)))
    call("identify", door / "log.csv", "--out", door / "out")
    with pytest.raises(ValueError, match=r"log\.csv"):
        read_table(door / "log.csv", {"t_s", "v"}).numbers("v")


def _bag(stranger, door):
    """Write a bag with definitions from which its reader would generate code: they are ignored."""
    code = f"string X=\"'\\n__import__('os').mkdir('{stranger}/marker')#\"\nfloat64 x\n__import__\n"
    with (door / "bag.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema("geometry_msgs/msg/Twist", "ros2msg", code.encode())
        channel = writer.register_channel("/cmd_vel", "cdr", schema)
        for time in range(5):
            writer.add_message(channel, time, b"\0\1\0\0" + bytes(48), time)
        writer.add_attachment(0, 0, "term.py", "text/x-python", TERM.encode())
        writer.add_attachment(0, 0, f"{stranger}/evil.pkl", "application/x-pickle", pickle.dumps(Reduced(stranger)))
        writer.add_metadata("configuration", {"yaml": f"model: {stranger}/model.yaml"})
        writer.finish()
    for command in ("identify",):
        call(command, door / "bag.mcap", "--out", door / "out.png")
    call("log", "replay", door / "bag.mcap")


def _bag_folder(stranger, door):
    for text in (
        f"rosbag2_bagfile_information: !!python/object/apply:os.mkdir ['{stranger}/marker']\n",
        yaml.safe_dump({"rosbag2_bagfile_information": {"relative_file_paths": [f"{stranger}/code.so"]}}),
    ):
        (door / "metadata.yaml").write_text(text)
        call("identify", door, "--out", door / "out")


def _drive_log(stranger, door):
    """Write a log of a drive whose configuration names code; with another configuration it is ignored."""
    texts = [
        f"terms: [{{file: {stranger}/term.py, function: run}}]",
        f"model: {stranger}/model.yaml",
        f"solver: {{method: {stranger}/code.so}}",
        f"name: !!python/object/apply:os.mkdir ['{stranger}/marker']",
        "[1, 2]",
    ]
    for text in texts:
        with (door / "log.mcap").open("wb") as file:
            writer = Writer(file)
            writer.start()
            schema = writer.register_schema("diffdrive_mpc.State", "jsonschema", b"{}")
            channel = writer.register_channel("/diffdrive_mpc/state", "json", schema)
            for time in range(3):
                row = {"t_s": 0.02 * time, "mode": f"\x1b[2J{stranger}/term.py", "message": "!!python/name:os.mkdir"}
                writer.add_message(channel, time, json.dumps(row).encode(), time)
            writer.add_attachment(0, 0, "evil.pkl", "application/x-pickle", pickle.dumps(Reduced(stranger)))
            writer.add_metadata("configuration", {"yaml": text})
            writer.add_metadata("case", {"plant": f"mujoco:{stranger}/model.yaml"})
            writer.finish()
        call("log", "replay", door / "log.mcap")


def _ticks(stranger, _):
    """Write messages of a node about its ticks, which a bag may contain."""
    lines = [json.dumps({"format": 1, "py/object": "os.mkdir", "drive": f"{stranger}/term.py"}), "[" * 100_000, "1"]
    for line in [*lines, pickle.dumps(Reduced(stranger)).decode("latin-1")]:
        for kind in (TickRecord, DriveRecord):
            with pytest.raises(ValueError, match=r"no record|no JSON|format"):
                kind.read(line)


def _messages(stranger, _):
    for kind in ("std_msgs/msg/String", "nav_msgs/msg/Path", "trajectory_msgs/msg/MultiDOFJointTrajectory"):
        with pytest.raises(Exception):  # noqa: B017 - the library's own kinds
            decoded(kind, pickle.dumps(Reduced(stranger)))
    from diffdrive_mpc.mpc.ros.conversions import MessageError, check_frame
    from diffdrive_mpc.mpc.ros.parameters import fields

    with pytest.raises(MessageError, match=r"\\x1b\[2J"):
        check_frame("\x1b[2J", "odom", "odom_frame")
    # Who can set parameters of a node names no code: lists, such as the terms, come by file only.
    assert not [name for name, _ in fields(ControllerConfig) if name.startswith("terms")]


def _weights(stranger, door):
    """Write pickles and libraries in place of the weights of a network."""
    objects = io.BytesIO()
    np.savez(objects, input_0=np.array([Reduced(stranger)], dtype=object))
    bare = io.BytesIO()
    np.save(bare, np.array([Reduced(stranger)], dtype=object))
    for content in (objects.getvalue(), bare.getvalue(), pickle.dumps(Reduced(stranger)), TERM.encode()):
        call("models", "show", network(door, content))
    call("models", "show", network(door, b"", weights=f"{stranger}/evil.npz"))
    call("models", "show", network(door, b"", weights="../stranger/evil.npz"))


def _model(stranger, door):
    """Write a model with the name of a module or a file as its structure, which must be that of an installed part."""
    for structure in ("stranger_code:run", f"{stranger}/term.py", f"{stranger}/code.so", "os"):
        (door / "model.yaml").write_text(yaml.safe_dump({"structure": structure, "name": "odd"}))
        call("models", "show", door / "model.yaml")


DOORS = {
    **{name: partial(_yaml, command, TAGS[0]) for name, command in YAML.items()},
    **{tag.split()[0]: partial(_yaml, YAML["model"], tag) for tag in TAGS[1:]},
    "a CSV log": _csv,
    "a bag and its attachments": _bag,
    "a folder of a bag": _bag_folder,
    "a log of a drive and its attachments": _drive_log,
    "records of ticks": _ticks,
    "messages of ROS": _messages,
    "weights of a network": _weights,
    "a model file": _model,
}


@pytest.mark.parametrize("name", DOORS)
def test_input_is_never_executed(name, stranger, tmp_path, monkeypatch):
    door = tmp_path / "door"
    door.mkdir()
    monkeypatch.syspath_prepend(str(stranger))
    events.clear()
    monkeypatch.setitem(watched, "folder", f"{stranger}/")
    DOORS[name](stranger, door)
    assert not events
    assert not (stranger / "marker").exists()
    assert "stranger_code" not in sys.modules


# What could execute a file stands in few places, each with its reason.

EXECUTES = re.compile(
    r"yaml\.(?:load|full_load|unsafe_load)\(|(?:np|numpy)\.load\(|\bpickle\.loads?\(|\beval\(|(?<![\w.])exec\("
    r"|exec_module\(|CDLL\(|dlopen\(|\bexternal\(|\bjoblib\.load\(|\bshelve\.|run_path\(|allow_pickle=True"
)
WHERE = {
    "models/checked_yaml.py": "safe loader, within bounds",
    "models/compiled/packaged.py": "compiled C of the package, or of the user's own cache",
    "models/logs/drive_log/recorder.py": "a socket between this process and the one that it began",
    "mpc/core/library.py": "likewise, with terms that the user's configuration names",
    "mpc/problem/terms.py": "the file of a term, where it is trusted",
    "sim/core/library.py": "compiled C of the package",
}


def test_few_places_could_execute_a_file():
    places = {
        str(path.relative_to(ROOT))
        for room in ("app", "bench", "models", "mpc", "sim", "src")
        for path in (ROOT / room).rglob("*.py")
        if EXECUTES.search(path.read_text(encoding="utf-8"))
    }
    assert places == set(WHERE)


# Bounds: what is small on the disk and large in memory is counted first. The measured commands run in one process.

MOST_MEMORY = 120.0
"""MB above what a command takes that loads a model of every kind; a bomb below takes 1,000 to 5,000."""
MEASURE = """
import json, resource, sys
from typer.testing import CliRunner
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.logs.csv_table import read_table
resource.setrlimit(resource.RLIMIT_AS, (4_000_000_000, 4_000_000_000))
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
for words in sys.stdin.read().splitlines():
    result = CliRunner().invoke(app, words.split())
    print(json.dumps([result.exit_code, type(result.exception).__name__, result.output, peak()]))
"""


def network(door, packed, weights=None, name="network", **architecture):
    """Write the file of a network with these bytes as weights."""
    data = yaml.safe_load(NETWORK.read_text(encoding="utf-8"))
    data |= {"weights": weights or f"{name}.npz", "sha256": hashlib.sha256(packed).hexdigest()}
    data["architecture"] |= architecture
    (door / f"{name}.npz").write_bytes(packed)
    (door / f"{name}.yaml").write_text(yaml.safe_dump(data))
    return door / f"{name}.yaml"


def archive(**changed):
    """Return the shipped weights as an npz archive, with other bytes for some of its arrays."""
    whole = io.BytesIO()
    with (
        zipfile.ZipFile(NETWORK.with_suffix(".npz")) as good,
        zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for name in good.namelist():
            packed.writestr(name, changed.get(name.removesuffix(".npy"), good.read(name)))
    return whole.getvalue()


def array(shape, content=b"", kind="<f8"):
    """Return an array in NumPy's format, whose declared size may exceed its content."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": kind, "fortran_order": False, "shape": shape})
    return file.getvalue() + content


def encrypted(packed):
    """Return the archive with the mark of encryption on every entry."""
    return re.sub(rb"(PK\x01\x02.{4})..", lambda match: match[1] + b"\1\0", packed, flags=re.DOTALL)


def bombs(door):
    """Return a command and the required part of its message, by the error of the file that it reads."""
    good = NETWORK.with_suffix(".npz").read_bytes()
    zeros = bytes(80_000_000)
    networks = {
        **{f"{key} of 1e9": (good, {key: 10**9}, "architecture") for key in ("window", "units")},
        "bomb": (archive(dense=array((10_000_000,), zeros)), {}, "unpacks to"),
        "large": (good + bytes(1_000_000), {}, "larger than"),
        "array that says 8 TB": (archive(dense=array((10**12,))), {}, "shape"),
        "objects": (archive(dense=array((30, 32), kind="|O")), {}, "object"),
        "deep header": (archive(dense=b"\x93NUMPY\1\0\xff\x1f" + b"(" * 0x1FFF), {}, "weights"),
        "encrypted": (encrypted(archive()), {}, "encrypted"),
    }
    for count, (packed, architecture, words) in enumerate(networks.values()):
        yield f"models show {network(door, packed, name=f'network{count}', **architecture)}", words
    sm = yaml.safe_load(model_path("sm").read_text(encoding="utf-8"))
    ssm = yaml.safe_load(model_path("ssm").read_text(encoding="utf-8")) | {"A": [[0.0] * 300] * 300}
    aliases = "\n".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}' if i else '0'] * 10)}]" for i in range(12))
    files = {
        "states": (yaml.safe_dump(ssm), "64 items"),
        "aliases": (aliases, "values"),
        "values": ("a: [" + "1, " * 200_000 + "1]", "200,000 values"),
        "name": (yaml.safe_dump({**sm, "name": 5}), "name"),
    }
    for name, (text, words) in files.items():
        (door / f"{name}.yaml").write_text(text)
        yield f"models show {door / name}.yaml", words
        if name in ("aliases", "values"):
            yield f"config check {door / name}.yaml", words


def test_small_files_of_large_content_are_refused_without_memory(tmp_path):
    listed = list(bombs(tmp_path))
    commands = "\n".join(["models show lstm", "identify none.csv", *(command for command, _ in listed)])
    done = subprocess.run(
        [sys.executable, "-c", MEASURE], input=commands, capture_output=True, text=True, check=True, timeout=300
    )
    _, (_, _, _, usual), *results = map(json.loads, done.stdout.splitlines())
    for (command, words), (code, kind, output, peak) in zip(listed, results, strict=True):
        assert (code, kind) == (2, "SystemExit"), (command, kind, output)
        assert words in output and output.startswith("error: ") and output.count("\n") == 1, (command, output)
        assert peak < usual + MOST_MEMORY, (command, peak, usual)


def test_escape_sequences_of_names_are_printed_as_text(tmp_path):
    data = yaml.safe_load(model_path("ssm").read_text(encoding="utf-8"))
    data["name"] = "odd\x1b[2J\x07\u202e"
    data["provenance"]["notes"] = "a note\x1b]0;owned\x07"
    (tmp_path / "odd.yaml").write_text(yaml.safe_dump(data))
    for words in (["models", "show"], ["models", "check"]):
        printed = CliRunner().invoke(app, [*words, str(tmp_path / "odd.yaml")], color=True).output
        assert r"odd\x1b[2J" in printed
        assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f\u202e]", printed)
