"""The command line of the studies, `python -m studies NAME` in a clone.

A package has its studies in `packages/PACKAGE/studies/NAME`, with the function `run` and its `EXAMPLE` in `command.py`.
`studies` is a namespace package: the folders of the packages are parts of it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import typer

from diffdrive_mpc.app.command_line.one_line_errors import OneLineErrors, build_only_named, leave_on_sigterm
from studies import commands
from studies.commands import shipped_models_app


class Studies(OneLineErrors):
    """The studies."""

    program = "python -m studies"


app = typer.Typer(
    cls=Studies,
    no_args_is_help=True,
    rich_markup_mode=None,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Repeat a study: the evidence for this project's own claims.",
)
for _name, _study in commands.STUDIES.items():
    app.command(_name, epilog=commands.EXAMPLES[_name])(_study)


def _package_studies() -> Iterator[tuple[str, ModuleType]]:
    """Yield the studies of packages: name and module of each command; makes their folders importable."""
    for file in sorted(Path(__file__).resolve().parents[1].glob("packages/*/studies/*/command.py")):
        package, name = str(file.parents[2]), file.parent.name
        if package not in sys.path:
            sys.path.append(package)
        yield name.replace("_", "-"), import_module(f"studies.{name}.command")


for _name, _module in _package_studies():
    app.command(_name, epilog=_module.EXAMPLE)(_module.run)
app.add_typer(shipped_models_app, name="models")


def main() -> None:
    """Run `python -m studies`."""
    leave_on_sigterm()
    build_only_named(app, sys.argv[1:])
    app(prog_name=Studies.program)
