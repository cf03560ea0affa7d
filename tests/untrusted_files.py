"""Untrusted files, and commands with a record of the files that they open."""

import sys
from pathlib import Path

import yaml
from typer.testing import CliRunner

from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.load import PARAMETERS as MODELS

SHORT = "name: short\nsegments:\n- {v: 0.4, omega: 0.5, duration: 0.6}\n"
_TERM = """
import pathlib
import casadi as ca
pathlib.Path(__file__).with_name("marker").touch()
twist = ca.SX.sym("twist", 2)
slow = ca.Function("slow", [twist], [twist[0]], ["twist"], ["v"])
"""

_opened: list[Path] = []


def _record(event, arguments):
    if event == "open" and isinstance(arguments[0], (str, Path)):
        _opened.append(Path(arguments[0]))


sys.addaudithook(_record)


def write_untrusted_files(folder):
    """Write a configuration, its model, its term, which creates the file `marker` when it runs, and a trajectory."""
    folder.mkdir()
    (folder / "term.py").write_text(_TERM)
    (folder / "model.yaml").write_bytes((MODELS / "ssm.yaml").read_bytes())
    (folder / "short.yaml").write_text(SHORT)
    terms = [{"file": str(folder / "term.py"), "function": "slow"}]
    (folder / "config.yaml").write_text(yaml.safe_dump({"model": "ssm", "terms": terms}))
    return folder


def call(*arguments):
    """Return exit code, output, and opened files of a command."""
    _opened.clear()
    result = CliRunner().invoke(app, [str(word) for word in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), (arguments, result.exception)
    return result.exit_code, " ".join(result.output.split()), list(_opened)
