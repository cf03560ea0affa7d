"""The log of a run as `simulate --log` writes it: CSV, or MCAP with a description of the run."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import yaml

from diffdrive_mpc.bench.case import DIMENSIONS, NO_MODEL, Case, label
from diffdrive_mpc.bench.controllers import controller_config
from diffdrive_mpc.bench.machine import project_version
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.load import model_path
from diffdrive_mpc.models.whole_file import reason, whole_file
from diffdrive_mpc.sim import Run

WriteLog = Callable[..., None]


def holds_plans(log: Path | None) -> bool:
    """Return True if a log of this name contains predictions, which the run must then store."""
    return log is not None and log.suffix == ".mcap"


@contextmanager
def run_log(log: Path | None) -> Iterator[WriteLog]:
    """Return the writer of a run's log, if one was requested; the file appears in the end, whole or not at all.

    It takes the run, its case, and the words of the command that repeats it if `simulate` does not.

    Parameters
    ----------
    log
        The file, whose ending selects the format: .mcap, else CSV; None for no log.

    Raises
    ------
    models.checked_yaml.ConfigError
        With the name of the option, if the file cannot be written, at once or in the end.
    """
    if log is None:
        yield lambda *_: None
        return

    def write(run: Run, case: Case, command: Sequence[str] = ()) -> None:
        try:
            if holds_plans(log):
                from diffdrive_mpc.sim.log_mcap import write_ticks  # noqa: PLC0415 - loads slowly

                write_ticks(run, draft, _told(case, command or ["simulate", *repeating(case)]))
            else:
                from diffdrive_mpc.sim.log_csv import write_rows  # noqa: PLC0415 - most runs leave no log

                write_rows(run, draft)
        except OSError as error:
            raise ConfigError(f"--log {log}: cannot be written ({reason(error)})") from error

    with ExitStack() as stack:
        try:
            draft = stack.enter_context(whole_file(log))
        except ConfigError as error:
            raise ConfigError(f"--log {error}") from error
        yield write


def repeating(case: Case) -> list[str]:
    """Return the arguments of `simulate` that repeat a case."""
    chosen = [
        dimension for dimension in DIMENSIONS if getattr(case, dimension.name) not in (dimension.default, NO_MODEL)
    ]
    words = [word for option in chosen for word in (option.option, str(getattr(case, option.name)))]
    words += ["--config", case.config] if case.config else []
    words += ["--scale-to-robot"] if case.scaled else []
    return words + [word for key, value in case.overrides for word in ("--set", f"{key}={value}")]


def _told(case: Case, command: Sequence[str]) -> dict[str, Mapping[str, str]]:
    """Return the metadata of the run, by name of the record."""
    labels = {name: str(value) for name, value in case.labels.items()}
    version = {"version": project_version(), "repeat": shlex.join(["diffdrive-mpc", *command])}
    metadata: dict[str, Mapping[str, str]] = {"case": {**version, **labels}}
    if case.controller not in PEERS:
        config = controller_config(case.model, case.config, case.overrides)
        values = config.model_dump(mode="json") | {"model": label(config.model)}
        metadata["configuration"] = {"yaml": yaml.safe_dump(values, sort_keys=False, allow_unicode=True)}
        metadata["model"] = {"yaml": model_path(config.model).read_text(encoding="utf-8")}
    return metadata
