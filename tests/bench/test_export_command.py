"""The command `export`: what it writes, and what it says to bad input."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from diffdrive_mpc.mpc.export.osqp_workspaces import QpShape
from diffdrive_mpc.mpc.export.parts import build_parts
from diffdrive_mpc.mpc.export.reference_table import table_text
from export_parts import SpoiledReference, compile_c

from diffdrive_mpc.bench.export.command import export_library
from diffdrive_mpc.mpc import load_config, load_trajectory
from diffdrive_mpc.mpc.export import Precision, export_controller

COMMAND = Path(sys.executable).with_name("diffdrive-mpc")


def run(folder, *words):
    command = [str(COMMAND), "export", "--set", "horizon=8", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_the_folder_is_complete(tmp_path):
    result = run(tmp_path, "--model", "mbm", "--precision", "float", "--out", "out")
    assert result.returncode == 0, result.stderr
    report = json.loads((tmp_path / "out" / "export.json").read_text())
    assert (report["model"], report["states"], report["horizon"], report["precision"]) == ("mbm", 8, 8, "float")
    assert report["config"]["solver"]["max_iterations"] == report["iteration_limit"]
    sizes = {size["target"]: size for size in report["sizes"]}
    table = 4 * 5 * len(re.findall(r"^    [{]R", (tmp_path / "out/ddmpc/trajectory.c").read_text(), re.MULTILINE))
    assert table > 4 * 5 * 13.07 / 0.0202
    assert sizes["host example"]["flash_bytes"] > table
    readme = (tmp_path / "out" / "README.md").read_text()
    assert "{" not in readme.replace("input = {0}", "").replace("{\n", "")
    assert f"{sizes['host example']['ram_bytes']:,}" in readme
    example = tmp_path / "example"
    out = tmp_path / "out"
    sources = [str(path) for name in ("ddmpc", "osqp/src", "osqp") for path in sorted((out / name).glob("*.c"))]
    includes = [f"-I{out / name}" for name in ("ddmpc", "osqp", "osqp/inc/public", "osqp/inc/private")]
    compile_c("-std=c99", *includes, *sources, str(out / "examples" / "main.c"), "-lm", "-o", str(example))
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


@pytest.mark.parametrize(
    ("choice", "said"),
    [
        ({"precision": "half"}, "--precision 'half': give double or float"),
        ({"precision": "float", "settings": ["solver.tolerance=1e-8"]}, "solver.tolerance = 1e-08: single precision"),
        ({"soft_slots": 151}, "--soft-slots 151: give 1 to 150"),
        ({"settings": ["limits.omega=0.3"]}, "slow the reference down or raise the limit"),
        ({"settings": ["solver.formulation=sparse"]}, "only the condensed formulation with osqp"),
        ({"model": "smm"}, "unknown model 'smm'"),
        ({"model": " "}, "--model: it is empty"),
        ({"trajectory": "triangle"}, "triangle"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(tmp_path, choice, said):
    options = {"model": None, "config": None, "settings": [], "trajectory": "circle", "precision": "double"}
    options |= {"soft_slots": None, "emulated": False} | choice
    with pytest.raises(ValueError, match=re.escape(said)) as caught:
        export_library(tmp_path / "out", **options)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_an_impossible_reference_is_refused(tmp_path):
    reference = SpoiledReference("circle")
    reference.spoiled_from = 5.0
    with pytest.raises(ValueError, match="reference 'circle'.*not finite"):
        table_text(reference, 0.0202)


def test_a_file_in_the_way_is_named(tmp_path):
    (tmp_path / "out").write_text("kept")
    result = run(tmp_path, "--out", "out")
    assert result.returncode == 2
    assert "--out out" in result.stderr
    assert (tmp_path / "out").read_text() == "kept"


def test_rows_of_unit_length():
    """Scaled rows a have a H^-1 a' = 1: what one limit costs does not depend on its unit."""
    parts = build_parts(load_config("ssm", {"horizon": 6}))
    hessian, soft = parts.typical_program()
    scale = QpShape(hessian, soft, slots=6).hard_scale()
    unit = np.eye(12)
    rows = scale[:, None] * np.vstack([unit, unit - np.eye(12, k=-2)])
    assert np.allclose(np.einsum("ij,ij->i", rows, np.linalg.solve(hessian, rows.T).T), 1.0)
    assert (np.linalg.eigvalsh(hessian) > 0).all()


def test_the_table_ends_with_the_trajectory():
    reference = load_trajectory("s")
    source, _ = table_text(reference, 0.5)
    rows = [line for line in source.splitlines() if line.startswith("    {R(")]
    last = [float(cell.strip("{} R(),")) for cell in rows[-1].split(", ")]
    assert np.allclose(last[:3], reference.sample([reference.duration]).pose[0])
    assert len(rows) == int(np.ceil(reference.duration / 0.5)) + 1
