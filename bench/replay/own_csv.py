"""A CSV log of `diffdrive-mpc simulate`, row by row as its controller had it."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.replay.logged_reference import logged_reference
from diffdrive_mpc.bench.replay.recording import Recording, Start, Tick
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.csv_log import OWN_FORMAT
from diffdrive_mpc.models.logs.csv_table import read_header
from diffdrive_mpc.models.logs.mapping import load_mapping
from diffdrive_mpc.sim.told import is_told, told_measurements

_TEXTS = ("mode", "solver_status", "solver_path", "message")


def is_own_csv(path: Path) -> bool:
    """Whether the columns are those of `simulate --log`."""
    columns, header = load_mapping(OWN_FORMAT).columns, read_header(path)
    assert columns is not None
    return columns.names() | {"mode"} <= set(header)


def read_own_csv(path: Path) -> Recording:
    """Read a log that `simulate --log` has written; raises ConfigError if it is damaged or holds no tick."""
    numbers, texts, findings = _read(path)
    time, command = numbers["t_s"], np.column_stack([numbers["v_ref_m_s"], numbers["omega_ref_rad_s"]])
    measurements = told_measurements(numbers)
    between = f"{path.name}: reference"
    reference = logged_reference(numbers, between)
    said = zip(texts["mode"], texts["solver_path"], texts["message"], strict=True)
    ticks = [
        Tick(float(t), measurement, sent, None, None, None, *words)
        for t, measurement, sent, words in zip(time, measurements, command, said, strict=True)
    ]
    ticks[0] = replace(ticks[0], start=Start(reference, ticks[0].time, reset=False))
    approximated = []
    if reference is not None and reference.name == between:
        approximated.append(
            "The reference is known at the ticks alone, and interpolated between them: where the robot was off its path or "
            "its time, commands may differ by some mm/s and mrad/s; --trajectory with its file makes that exact."
        )
    if not is_told(tuple(numbers)):
        approximated.append(
            "The log is of a release before covariances and stamps were logged: readings count as of their tick with "
            "the configuration's noise, so that commands may differ by some mm/s and mrad/s."
        )
    return Recording(
        path.name,
        "CSV log of `diffdrive-mpc simulate`",
        tuple(ticks),
        approximated=tuple(approximated),
        findings=tuple(findings),
    )


def _read(path: Path) -> tuple[dict[str, FloatArray], Mapping[str, list[str]], list[str]]:
    """Numbers and texts by column, and what was found wrong."""
    findings: list[str] = []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            header, *rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read as CSV ({error})") from error
    if rows and len(rows[-1]) < len(header):
        rows.pop()
        findings.append(f"{path.name}: the last line is cut off; it is left out")
    for number, row in enumerate(rows, start=2):
        if len(row) != len(header):
            raise ConfigError(f"{path}, line {number}: {len(row)} cells, the header names {len(header)}")
    if not rows:
        raise ConfigError(f"{path}: the log holds no row; record for longer")
    columns = dict(zip(header, zip(*rows, strict=True), strict=True))
    texts = {name: list(columns.pop(name, ("",) * len(rows))) for name in _TEXTS}
    numbers = {name: _numbers(path, name, cells) for name, cells in columns.items()}
    known = np.isfinite(numbers["t_s"])
    if not known.all():
        lines = ", ".join(str(line) for line in np.flatnonzero(~known)[:5] + 2)
        findings.append(f"{path.name}, line {lines}: the row has no time; it is left out")
        numbers = {name: column[known] for name, column in numbers.items()}
        texts = {name: [text for text, keep in zip(cells, known, strict=True) if keep] for name, cells in texts.items()}
    if not len(numbers["t_s"]):
        raise ConfigError(f"{path}: no row has a time")
    return numbers, texts, findings


def _numbers(path: Path, name: str, cells: tuple[str, ...]) -> FloatArray:
    try:
        return np.array([cell or "nan" for cell in cells], dtype=float)
    except ValueError as error:
        raise ConfigError(f"{path}, column '{name}': {error}; leave a cell empty where a reading is missing") from error
