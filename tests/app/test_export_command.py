"""The command `export`: what it writes, and what it says to bad input."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from export_parts import SpoiledReference, compile_c

from diffdrive_mpc.mpc import load_config, load_trajectory
from diffdrive_mpc.mpc.core.sources import CORE
from diffdrive_mpc.mpc.export import Precision, export_controller
from diffdrive_mpc.mpc.export.generated_c import sizes_text, trajectory_texts
from diffdrive_mpc.mpc.problem.build import build_problem, chosen_model

COMMAND = Path(sys.executable).with_name("diffdrive-mpc")


def run(folder, *words):
    command = [str(COMMAND), "export", "--set", "horizon=8", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_the_folder_is_complete(tmp_path):
    result = run(tmp_path, "--model", "mbm", "--precision", "float", "--out", "out")
    assert result.returncode == 0, result.stderr
    report = json.loads((tmp_path / "out" / "export.json").read_text())
    assert (report["model"], report["states"], report["horizon"], report["precision"]) == ("mbm", 8, 8, "float")
    assert report["config"]["solver"]["active_set_iterations"] == report["iteration_limit"]
    sizes = {size["target"]: size for size in report["sizes"]}
    readme = (tmp_path / "out" / "README.md").read_text()
    assert "{" not in readme.replace("input = {0}", "").replace("{\n", "")
    assert f"{sizes['host example']['ram_bytes']:,}" in readme
    example = tmp_path / "example"
    out = tmp_path / "out"
    sources = [str(path) for path in sorted((out / "ddmpc").glob("*.c"))]
    compile_c("-std=c99", f"-I{out / 'ddmpc'}", *sources, str(out / "examples" / "main.c"), "-lm", "-o", str(example))
    # It drives a robot that obeys its model exactly: a few centimetres while it starts, and to the end.
    said = subprocess.run([str(example)], capture_output=True, text=True, check=True).stdout
    assert "\nfinished, largest error 0.0" in said
    system = subprocess.run(["nm", "-u", str(example)], capture_output=True, text=True, check=True).stdout
    needed = {line.split()[-1].split("@")[0] for line in system.splitlines()}
    assert not {"malloc", "calloc", "realloc", "free"} & needed


def test_the_same_configuration_gives_the_same_files(tmp_path):
    config, reference = load_config("ssm", {"horizon": 8}), load_trajectory("circle")
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        export_controller(config, reference, tmp_path / name, Precision.FLOAT)
    first, second = (
        {path.relative_to(tmp_path / name): path.read_bytes() for path in (tmp_path / name).rglob("*.*")}
        for name in ("first", "second")
    )
    assert first == second


def test_an_impossible_reference_is_refused(tmp_path):
    reference = SpoiledReference("circle")
    reference.spoiled_from = 5.0
    with pytest.raises(ValueError, match="reference 'circle'.*not finite"):
        trajectory_texts(reference, 0.0202)


def test_every_size_is_a_macro():
    """What internal.h calls them is what is written."""
    exported = (CORE / "internal.h").read_text().partition("#ifdef DDMPC_EXPORT")[2].partition("#else")[0]
    used = {name for name in re.findall(r"\bDDMPC_(\w+)", exported) if not name.startswith("MOST_")}
    config = load_config("ssm", {"horizon": 6})
    problem = build_problem(config, chosen_model(config, None))
    written = set(re.findall(r"#define DDMPC_(\w+) \d", sizes_text(problem, single=False)))
    # How many numbers a model is given matters to who writes them down, not to the core.
    assert used | {"MODEL_PARAMETERS"} == {name.upper() for name in problem.sizes}
    assert written == used | {"MODEL_PARAMETERS", "REALS", "INTS"}


def numbers_of(source: str, name: str) -> list[float]:
    body = re.search(rf" {name}\[\] = {{([^}}]*)}}", source)[1]
    return [float(number) for number in body.split(",")]


def test_a_trajectory_of_arcs_is_written_as_it_is():
    reference = load_trajectory("s")
    source = trajectory_texts(reference, 0.5)["trajectory.c"]
    assert numbers_of(source, "breaks") == reference.breaks.tolist()
    assert numbers_of(source, "table") == reference.table.ravel().tolist()
    assert ".cubic = 0" in source


def test_any_other_reference_is_fitted():
    """Cubic pieces, one a sample, that meet the reference at their ends."""
    reference = SpoiledReference("s")
    source = trajectory_texts(reference, 0.5)["trajectory.c"]
    breaks = numbers_of(source, "breaks")
    table = np.reshape(numbers_of(source, "table"), (16, -1))
    assert table.shape[1] == int(np.ceil(reference.duration / 0.5)) == len(breaks) - 1
    # The constant coefficients: the poses where the pieces begin.
    assert np.allclose(table[12:15].T, reference.sample(breaks[:-1]).pose)
    assert ".cubic = 1" in source
