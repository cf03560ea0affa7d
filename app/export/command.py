"""Write an exported controller and its report for the command line."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from diffdrive_mpc.app.export.emulation import emulate
from diffdrive_mpc.app.export.readme import readme
from diffdrive_mpc.app.export.sizes import TARGETS, Size, link_stm32f4, measure_sizes
from diffdrive_mpc.bench.atomic import staged
from diffdrive_mpc.bench.case import label
from diffdrive_mpc.bench.controllers import chosen_model, controller_config
from diffdrive_mpc.bench.machine import describe_run
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.sweep import single_settings
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import Reference
from diffdrive_mpc.mpc import ControllerConfig, load_trajectory
from diffdrive_mpc.mpc.export import FILES, FOLDERS, Precision, export_controller

README, REPORT = "README.md", "export.json"


def export_library(
    out: Path,
    *,
    model: str | None,
    config: Path | None,
    settings: Sequence[str],
    trajectory: str,
    precision: str,
    emulated: bool,
) -> None:
    """Export a controller into `out`, and print its sizes; parameters as the command's options.

    Raises ConfigError, ValueError or OSError if a name, a value or `out` cannot be used; then `out` keeps what it held.
    """
    began = time.perf_counter()
    if precision not in list(Precision):
        raise ConfigError(f"--precision '{precision}': give double or float")
    name = chosen_model(model, config)
    values = controller_config(name, None if config is None else str(config), single_settings(settings))
    reference = load_trajectory(trajectory, values)
    with (
        staged(out, files=(*FILES, README, REPORT), folders=FOLDERS, owner="export") as folder,
        ProgressBar("exporting") as bar,
    ):
        exported = export_controller(values, reference, folder, Precision(precision))
        sizes = measure_sizes(folder)
        facts = {
            "model": label(name),
            "states": exported.states,
            "horizon": values.horizon,
            "sample_time_s": values.sample_time,
            "precision": precision,
            "trajectory": label(trajectory),
            "terms": list(exported.terms),
            "iteration_limit": values.solver.active_set_iterations,
            "sizes": [size.as_json() for size in sizes],
        }
        if emulated:
            facts["emulation"] = _emulate(folder, values, reference, bar)
        tables = [size_table(sizes), *([emulation_table(facts["emulation"])] if emulated else [])]
        (folder / README).write_text(readme(facts, tables), encoding="utf-8")
        report = {
            "meta": describe_run(time.perf_counter() - began),
            **facts,
            "config": {**values.model_dump(mode="json"), "model": label(name)},
        }
        (folder / REPORT).write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    console = output_console()
    for table in tables:
        console.print(table.rich())
    console.print(f"controller in {out}: {name}, {values.horizon} steps, {precision} precision", highlight=False)


def _emulate(folder: Path, config: ControllerConfig, reference: Reference, bar: ProgressBar) -> dict[str, object]:
    with TemporaryDirectory() as scratch:
        image = Path(scratch) / "program.elf"
        if not link_stm32f4(folder, image):
            raise ConfigError("--emulate: the program does not fit into an STM32F4; export float, or a shorter horizon")
        bar.begin("emulating", 1)
        return emulate(image, config, reference, bar.at).as_json()


def emulation_table(emulation: object) -> Table:
    """Instructions of a step on the emulated microcontroller."""
    facts = dict(emulation) if isinstance(emulation, Mapping) else {}
    counts = [f"{facts[f'instructions_{name}']:,}" for name in ("p50", "p95", "p99", "max")]
    return Table(
        "Instructions of a step",
        ("machine", "steps", "p50", "p95", "p99", "max", "iterations", "position RMSE [m]", "to Python"),
        (
            (
                str(facts["machine"]),
                str(facts["steps"]),
                *counts,
                str(facts["iterations_max"]),
                number(facts["position_rmse_m"]),
                f"{facts['command_difference_max']:.1e}",
            ),
        ),
        note="Over one drive of the MuJoCo robot; `iterations`: the most of one step; `to Python`: the largest "
        "difference of a command [m/s, rad/s].",
    )


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
