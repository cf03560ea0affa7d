"""Reporting of user errors as one line on stderr and an exit code."""

from __future__ import annotations

import re
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from types import FrameType
from typing import Any, ClassVar, NoReturn, TextIO

import typer

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.app.command_line.groups import FullHelp
from diffdrive_mpc.models.table import plain_line
from diffdrive_mpc.models.typed_command import set_command_line

BAD_INPUT = 2
"""Exit code for invalid input."""
FAILED = 1
"""Exit code for any other failure."""
INTERRUPTED = 130
"""Exit code after Ctrl-C: 128 plus the number of the signal, as in shells."""
TERMINATED = 143
"""Exit code after SIGTERM: 128 plus the number of the signal."""

_ROS = "install diffdrive-mpc[ros], or source the setup file of ROS 2 Jazzy"
OPTIONAL_PACKAGES = {
    "mujoco": "pip install mujoco, or use --plant model:ssm",
    "rclpy": _ROS,
    "builtin_interfaces": _ROS,
    "geometry_msgs": _ROS,
}
"""Packages that only some commands require, with the remedy for a missing package."""


_SINGULARS = {"trajectories": "trajectory", "models": "model"}
"""Option for a single value, by option for several values; not for `seeds`, whose value is the number of seeds."""


class OneLineErrors(FullHelp):
    """Group of commands that report bad input as `error: ...` and exit code 2, without a traceback.

    Bad input means a ValueError (including ConfigError and ModelError), an OSError, or an error of the command-line
    parser. Other errors of this project are reported in one line with exit code 1. All other exceptions have a
    traceback.
    """

    program: ClassVar[str] = "diffdrive-mpc"
    """Name of the program before the command."""

    def make_context(self, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401 - the signature of the base class
        """Parse the arguments; `--trajectory` and `--trajectories` are synonyms in the commands of this group."""
        return super().make_context(*args, token_normalize_func=_singular, **kwargs)

    def main(self, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401 - the signature of the base class
        """Parse the command line, run the command and exit."""
        kwargs["standalone_mode"] = False
        arguments = args[0] if args else kwargs.get("args")
        try:
            with (
                set_command_line(sys.argv[1:] if arguments is None else arguments, self.program),
                warnings.catch_warnings(),
            ):
                _SHOWN_NOTES.clear()
                warnings.showwarning = _show_warning
                code = super().main(*args, **kwargs)
        except typer.Abort:
            code = INTERRUPTED  # older versions of typer raise Abort on Ctrl-C; newer ones return the exit code
        except ModuleNotFoundError as error:
            if error.name not in OPTIONAL_PACKAGES:
                raise
            _print_error(f"the package '{error.name}' is not installed; {OPTIONAL_PACKAGES[error.name]}")
            sys.exit(FAILED)
        except (ValueError, OSError) as error:
            _print_error(str(error))
            sys.exit(BAD_INPUT)
        except Exception as error:
            # The errors of the parser have no public base class that exists in all versions of typer.
            if not hasattr(error, "format_message"):
                from diffdrive_mpc.models.errors import DiffdriveMpcError  # noqa: PLC0415 - --help does not need it

                if not isinstance(error, DiffdriveMpcError):
                    raise
                _print_error(str(error))
                sys.exit(FAILED)
            if type(error).__name__ == "NoArgsIsHelpError":
                echo(error.format_message())
            else:
                with suppress(ValueError):  # no other option is similar
                    (getattr(error, "possibilities", None) or []).remove("--help")
                parser_error = error.format_message().rstrip(".")
                _print_error(f"{parser_error}; {_remedy(parser_error, error)}see --help")
            sys.exit(BAD_INPUT)
        if code == INTERRUPTED:
            _print_error("aborted")
        sys.exit(code if isinstance(code, int) else 0)


def _remedy(parser_error: str, error: Any) -> str:  # noqa: ANN401 - classes that typer does not export
    """Return a hint for an extra argument, or an option that another option or a key replaces; otherwise ""."""
    options = {name for option in error.ctx.command.params for name in option.opts} if error.ctx else set()
    if "--set" in options and (unknown := re.match(r"No such option: --([a-z-]+)", parser_error)):
        from diffdrive_mpc.mpc.config.schema import ControllerConfig  # noqa: PLC0415 - --help does not need it

        key = unknown[1].replace("-", "_")
        return f"for the value of the configuration: --set {key}=VALUE; " * (key in ControllerConfig.model_fields)
    if "--structure" in options and parser_error.startswith("No such option: --model "):
        return "the option for the kind of model is --structure; "
    if re.match(r"No such option: -\w$", parser_error):
        return "a name of several letters follows two dashes, as in --help; "
    if "extra argument" not in parser_error or not options & {"--model", "--models"}:
        return ""
    from diffdrive_mpc.mpc.trajectories.load import BUILT_IN  # noqa: PLC0415 - --help does not need it

    words = re.findall(r"[\w.]+", parser_error.rpartition("(")[2])
    paths = [word for word in words if word in BUILT_IN]
    known = f"--trajectory {paths[0]}" if paths else "--set horizon=20" if words[0].isdigit() else "--model ssm"
    several = ", and commas separate several values" if "--horizons" in options else ""
    return f"a value follows its option, as in {known}{several}; "


_SHOWN_NOTES: set[str] = set()


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Print a note about the content of a file, or any other warning in Python's format."""
    if "NoteWarning" in (base.__name__ for base in category.__mro__):
        # A file may be read twice, but a note about it is printed once.
        note = f"note: {plain_line(str(message))}"
        if note not in _SHOWN_NOTES:
            _SHOWN_NOTES.add(note)
            echo(note, err=True)
    else:
        (file or sys.stderr).write(warnings.formatwarning(message, category, filename, lineno, line))


def _singular(name: str) -> str:
    """Return the singular form of an option's name, which the parser uses for both forms."""
    return _SINGULARS.get(name, name)


def build_named_options(app: typer.Typer, words: Sequence[str]) -> None:
    """Build only the options of the commands in `words`, because building all options takes long.

    The other commands have only a name and a help text, for the overview.
    """
    for command in app.registered_commands:
        if command.name not in words and command.callback is not None:
            command.callback = _without_options(command.callback)
    for group in app.registered_groups:
        if group.typer_instance is not None and group.name not in words:
            build_named_options(group.typer_instance, words)


def _without_options(callback: Callable[..., Any]) -> Callable[[], None]:
    def placeholder() -> None: ...

    placeholder.__doc__ = callback.__doc__
    return placeholder


def leave_on_sigterm() -> None:
    """Handle SIGTERM like Ctrl-C: remove partial files and end child processes."""
    if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _terminate)


def _terminate(_number: int, _frame: FrameType | None) -> NoReturn:
    # A second SIGTERM ends the process immediately.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    _print_error("ended by SIGTERM")
    sys.exit(TERMINATED)


def _print_error(message: str) -> None:
    echo(f"error: {plain_line(message)}", err=True)
