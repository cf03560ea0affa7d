"""The command line, invoked within the process of the tests."""

from __future__ import annotations

from typing import TYPE_CHECKING

from typer.testing import CliRunner

from diffdrive_mpc.app.cli import app as product

if TYPE_CHECKING:
    from click.testing import Result
    from typer import Typer


def invoke(app: Typer, *arguments: object, code: int = 0) -> Result:
    """Invoke a command of `app` and check that it ends with the exit code `code`."""
    result = CliRunner().invoke(app, [str(word) for word in arguments])
    assert result.exit_code == code, result.output
    return result


def call(*arguments: object, code: int = 0) -> str:
    """Return the output of a command of the product; check its exit code."""
    return invoke(product, *arguments, code=code).output


def refusal(*arguments: object, code: int = 2) -> str:
    """Return the error line of a refused command; check that the line is the only output."""
    result = invoke(product, *arguments, code=code)
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: ") and result.stdout == ""
    return line
