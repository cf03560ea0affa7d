"""Command line of the studies, `python -m studies NAME` in a clone.

The studies of a package are in `packages/PACKAGE/studies/NAME`, where `command.py` defines `run` and `EXAMPLE`.
`studies` is a namespace package that includes these folders.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import typer

from diffdrive_mpc.app.command_line.one_line_errors import OneLineErrors, build_named_options, leave_on_sigterm
from studies import commands
from studies.commands import shipped_models_app


class Studies(OneLineErrors):
    """Group of commands, one for each study."""

    program = "python -m studies"


app = typer.Typer(
    cls=Studies,
    no_args_is_help=True,
    rich_markup_mode=None,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Repeat a study that provides evidence for the claims of this project.",
)
for _name, _study in commands.STUDIES.items():
    app.command(_name, epilog=commands.EXAMPLES[_name])(_study)


def _package_studies() -> Iterator[tuple[str, ModuleType]]:
    """Make the studies of packages importable; yield the name and the module of each command."""
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
    build_named_options(app, sys.argv[1:])
    app(prog_name=Studies.program)
