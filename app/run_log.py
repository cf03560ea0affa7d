"""Log of a run, as written by `simulate --log`: CSV, or MCAP with a description of the run."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import yaml

from diffdrive_mpc.bench.case import DIMENSIONS, NO_MODEL, Case, label
from diffdrive_mpc.bench.drive import odometry_correction, sensor_readings
from diffdrive_mpc.bench.html_report.origin import mpc_config
from diffdrive_mpc.bench.machine import project_version
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.load import model_path
from diffdrive_mpc.models.logs.mcap_file import MCAP_MAGIC
from diffdrive_mpc.models.whole_file import reason, whole_file
from diffdrive_mpc.mpc import ControllerConfig
from diffdrive_mpc.sim import Run
from diffdrive_mpc.sim.log_csv import FIRST_COLUMNS

WriteLog = Callable[..., None]
_STARTS = {".csv": FIRST_COLUMNS, ".mcap": MCAP_MAGIC}
"""First bytes of a log by suffix."""


def includes_plans(log: Path | None) -> bool:
    """Return True if the format of a log contains predicted plans, which the run must then store."""
    return log is not None and log.suffix == ".mcap"


@contextmanager
def run_log(log: Path | None) -> Iterator[WriteLog]:
    """Yield a function that writes the log of a run; on exit the complete file is created, or no file after a failure.

    The arguments of the function are the run, the case, and the arguments of the command that repeats the run, by
    default `simulate`.

    Parameters
    ----------
    log
        Path of the file; the suffix .mcap selects MCAP, and .csv CSV. None for no log.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file has another suffix, exists and is not a log, or cannot be written; the message contains the name
        of the option. Raised on entry or on exit.
    """
    if log is None:
        yield lambda *_: None
        return
    if log.suffix not in _STARTS:
        raise ConfigError(f"--log {log}: give a file name that ends in .csv or .mcap")

    def write(run: Run, case: Case, command: Sequence[str] = ()) -> None:
        try:
            if includes_plans(log):
                from diffdrive_mpc.sim.log_mcap import write_ticks  # noqa: PLC0415 - loads slowly

                config = mpc_config(case)
                metadata = _metadata(case, config, command or ["simulate", *repeat_arguments(case)])
                correction = odometry_correction(sensor_readings(config)) if config else (1.0, 1.0)
                write_ticks(run, draft, metadata, correction)
            else:
                from diffdrive_mpc.sim.log_csv import write_rows  # noqa: PLC0415 - most runs write no log

                write_rows(run, draft)
        except OSError as error:
            raise ConfigError(f"--log {log}: cannot be written ({reason(error)})") from error

    with ExitStack() as stack:
        try:
            draft = stack.enter_context(whole_file(log, begins=_STARTS[log.suffix]))
        except ConfigError as error:
            raise ConfigError(f"--log {error}") from error
        yield write


def repeat_arguments(case: Case) -> list[str]:
    """Return the arguments of `simulate` that repeat a case."""
    stated = [entry for entry in DIMENSIONS if getattr(case, entry.name) not in (entry.default, NO_MODEL)]
    words = [word for entry in stated for word in (entry.option, str(getattr(case, entry.name)))]
    words += ["--config", case.config] if case.config else []
    words += ["--scale-to-robot"] if case.scaled else []
    return words + [word for key, value in case.overrides for word in ("--set", f"{key}={value}")]


def _metadata(case: Case, config: ControllerConfig | None, command: Sequence[str]) -> dict[str, Mapping[str, str]]:
    """Return the metadata of a run by name of the metadata record; `config` is None for a peer."""
    labels = {name: str(value) for name, value in case.labels.items()}
    version = {"version": project_version(), "repeat": shlex.join(["diffdrive-mpc", *command])}
    metadata: dict[str, Mapping[str, str]] = {"case": {**version, **labels}}
    if config is not None:
        values = config.model_dump(mode="json") | {"model": label(config.model)}
        metadata["configuration"] = {"yaml": yaml.safe_dump(values, sort_keys=False, allow_unicode=True)}
        metadata["model"] = {"yaml": model_path(config.model).read_text(encoding="utf-8")}
    return metadata
