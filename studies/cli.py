"""The command line of the studies, `python -m studies NAME` in a clone."""

from __future__ import annotations

import sys

import typer

from diffdrive_mpc.app.command_line.one_line_errors import OneLineErrors, build_only_named, leave_on_sigterm
from studies.commands import studies
from studies.commands.shipped_models import shipped_models_app


class Studies(OneLineErrors):
    """The studies."""

    program = "python -m studies"


app = typer.Typer(
    cls=Studies,
    no_args_is_help=True,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Repeat a study: the evidence for this project's own claims.",
)
for _name, _study in studies.STUDIES.items():
    app.command(_name, epilog=studies.EXAMPLES[_name])(_study)
app.add_typer(shipped_models_app, name="models")


def main() -> None:
    """Entry point of `python -m studies`."""
    leave_on_sigterm()
    build_only_named(app, sys.argv[1:])
    app(prog_name=Studies.program)
