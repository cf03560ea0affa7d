"""Turn mistakes of the user into one line on stderr and an exit code."""

from __future__ import annotations

import re
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any, ClassVar, NoReturn, TextIO

import typer
from typer.core import TyperGroup

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.models.table import plain_line
from diffdrive_mpc.models.typed_command import typed

BAD_INPUT = 2
"""Exit code for input that cannot be used."""
FAILED = 1
"""Exit code for anything else that went wrong."""
INTERRUPTED = 130
"""Exit code after Ctrl-C: 128 plus the number of the signal, as shells have it."""
TERMINATED = 143
"""Exit code after SIGTERM, likewise."""

_ROS = "install diffdrive-mpc[ros], or source the setup file of ROS 2 Jazzy"
OPTIONAL_PACKAGES = {
    "mujoco": "pip install mujoco, or use --plant model:ssm",
    "rclpy": _ROS,
    "builtin_interfaces": _ROS,
    "geometry_msgs": _ROS,
}
"""Packages that only some commands need, with the remedy for each."""


_SINGULARS = {"trajectories": "trajectory", "models": "model"}
"""Options of one value by those of several; not `seeds`, which counts where `seed` names."""


class OneLineErrors(TyperGroup):
    """Group of commands that report bad input as `error: ...` and exit code 2, without a traceback.

    Bad input means ValueError (with ConfigError and ModelError), OSError, and errors of the command-line parser. The
    project's other errors end likewise, with exit code 1. Anything else is a fault and shows its traceback.
    """

    program: ClassVar[str] = "diffdrive-mpc"
    """Name of the program before the command."""

    def make_context(self, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401 - the signature of the base class
        """Parse the arguments; commands of this group accept `--trajectory` and `--trajectories` for each other."""
        return super().make_context(*args, token_normalize_func=_singular, **kwargs)

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - of classes that typer hides
        """List the commands under their panels."""
        panels: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(ctx):
            command: Any = self.get_command(ctx, name)
            panel = command.rich_help_panel if isinstance(command.rich_help_panel, str) else "Commands"
            if not command.hidden:
                panels.setdefault(panel, []).append((name, command.get_short_help_str(limit=1000)))
        for panel, rows in panels.items():
            with formatter.section(panel):
                formatter.write_dl(rows)

    def main(self, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401 - the signature of the base class
        """Parse the command line, run the command and exit."""
        kwargs["standalone_mode"] = False
        arguments = args[0] if args else kwargs.get("args")
        try:
            with typed(sys.argv[1:] if arguments is None else arguments, self.program), warnings.catch_warnings():
                _SHOWN_NOTES.clear()
                warnings.showwarning = _show_warning
                code = super().main(*args, **kwargs)
        except typer.Abort:
            code = INTERRUPTED  # how older versions of typer pass on Ctrl-C; newer ones return the exit code
        except ModuleNotFoundError as error:
            if error.name not in OPTIONAL_PACKAGES:
                raise
            _complain(f"the package '{error.name}' is not installed; {OPTIONAL_PACKAGES[error.name]}")
            sys.exit(FAILED)
        except (ValueError, OSError) as error:
            _complain(str(error))
            sys.exit(BAD_INPUT)
        except Exception as error:
            # The parser's own errors have no public base class that all versions of typer share.
            if not hasattr(error, "format_message"):
                from diffdrive_mpc.models.errors import DiffdriveMpcError  # noqa: PLC0415 - loads what --help needs not

                if not isinstance(error, DiffdriveMpcError):
                    raise
                _complain(str(error))
                sys.exit(FAILED)
            if type(error).__name__ == "NoArgsIsHelpError":
                echo(error.format_message())
            else:
                complaint = error.format_message().rstrip(".")
                _complain(f"{complaint}; {_remedy(complaint)}see --help")
            sys.exit(BAD_INPUT)
        if code == INTERRUPTED:
            _complain("aborted")
        sys.exit(code if isinstance(code, int) else 0)


def _remedy(complaint: str) -> str:
    """Return how to give a value without its option."""
    if "extra argument" not in complaint:
        return ""
    from diffdrive_mpc.mpc.trajectories.load import BUILT_IN  # noqa: PLC0415 - loads what --help needs not

    paths = [word for word in re.findall(r"\w+", complaint.rpartition("(")[2]) if word in BUILT_IN]
    return f"a value goes after its option, as in {f'--trajectory {paths[0]}' if paths else '--model ssm'}; "


_SHOWN_NOTES: set[str] = set()


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Show former names in a file as a note, and other warnings as Python does."""
    if category.__name__ == "FormerNameWarning":
        # A file that is read twice is reported once.
        note = f"note: {plain_line(str(message))}"
        if note not in _SHOWN_NOTES:
            _SHOWN_NOTES.add(note)
            echo(note, err=True)
    else:
        (file or sys.stderr).write(warnings.formatwarning(message, category, filename, lineno, line))


def _singular(name: str) -> str:
    """Return the name of an option without the plural of its sibling; both are read by this name."""
    return _SINGULARS.get(name, name)


def build_only_named(app: typer.Typer, words: Sequence[str]) -> None:
    """Build only the options of the commands that `words` name; to build all takes longer than to run one.

    The others show only their overview: their names and help.
    """
    for command in app.registered_commands:
        if command.name not in words and command.callback is not None:
            command.callback = _without_options(command.callback)
    for group in app.registered_groups:
        if group.typer_instance is not None and group.name not in words:
            build_only_named(group.typer_instance, words)


def _without_options(callback: Callable[..., Any]) -> Callable[[], None]:
    def shown() -> None: ...

    shown.__doc__ = callback.__doc__
    return shown


def leave_on_sigterm() -> None:
    """Let SIGTERM end this process as Ctrl-C does: partial files are removed, and child processes end."""
    if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _terminate)


def _terminate(_number: int, _frame: FrameType | None) -> NoReturn:
    # A second SIGTERM does not wait.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    _complain("ended by SIGTERM")
    sys.exit(TERMINATED)


def _complain(message: str) -> None:
    echo(f"error: {plain_line(message)}", err=True)
