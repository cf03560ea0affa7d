"""Write an exported controller and its report for the command line."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path

from bench.atomic import staged
from bench.case import label
from bench.console import output_console
from bench.controllers import controller_config, default_model
from bench.export.readme import readme
from bench.export.sizes import TARGETS, Size, measure_sizes
from bench.machine import describe_run
from bench.sweep import single_settings
from bench.table import Table
from models.checked_yaml import ConfigError
from mpc import load_trajectory
from mpc.export import FILES, FOLDERS, Precision, export_controller

REPORT = "export.json"


def export_library(
    out: Path,
    *,
    model: str | None,
    config: Path | None,
    settings: Sequence[str],
    trajectory: str,
    precision: str,
    soft_slots: int | None,
) -> None:
    """Export a controller into `out`, and print its sizes; parameters as the command's options.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError, OSError
        If a name, a value or `out` cannot be used; then `out` keeps what it held.
    """
    began = time.perf_counter()
    if precision not in list(Precision):
        raise ConfigError(f"--precision '{precision}': give double or float")
    if model is not None and not model.strip():
        raise ConfigError("--model: it is empty; give mbm, sm, ssm or the path of a model file")
    name = default_model(config) if model is None else model
    values = controller_config(name, None if config is None else str(config), single_settings(settings))
    reference = load_trajectory(trajectory)
    with staged(out, files=(*FILES, REPORT), folders=FOLDERS) as folder:
        exported = export_controller(values, reference, folder, Precision(precision), soft_slots)
        sizes = measure_sizes(folder)
        facts = {
            "model": label(name),
            "states": exported.states,
            "horizon": values.horizon,
            "sample_time_s": values.sample_time,
            "precision": precision,
            "trajectory": label(trajectory),
            "soft_slots": exported.slots,
            "iteration_limit": values.solver.max_iterations,
            "tolerance": values.solver.tolerance,
            "osqp": exported.osqp,
            "sizes": [size.as_json() for size in sizes],
        }
        (folder / "README.md").write_text(readme(facts, size_table(sizes)), encoding="utf-8")
        report = {
            "meta": describe_run(time.perf_counter() - began),
            **facts,
            "config": {**values.model_dump(mode="json"), "model": label(name)},
        }
        (folder / REPORT).write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    console = output_console()
    console.print(size_table(sizes).rich())
    console.print(f"controller in {out}: {name}, {values.horizon} steps, {precision} precision", highlight=False)


def size_table(sizes: Sequence[Size]) -> Table:
    """Static sizes: what the linker reserves; nothing is allocated later."""
    rows = [(size.target, size.compiler, f"{size.flash:,}", f"{size.ram:,}", f"{size.stack:,}") for size in sizes]
    missing = [name for name in TARGETS if name not in [size.target for size in sizes]]
    return Table(
        "Static sizes",
        ("program", "compiler", "flash [bytes]", "RAM [bytes]", "of it stack [bytes]"),
        tuple(rows),
        text_columns=2,
        note="; ".join(f"{name}: too large for it, or {TARGETS[name]} is not installed" for name in missing),
    )
