"""`diffdrive-mpc prove` and `repeat`, from the command line."""

import json
from pathlib import Path

import pytest
import yaml
from opened_report import content_of

from commands import call
from diffdrive_mpc_extras.campaign.definition import Definition
from diffdrive_mpc_extras.campaign.engine import check_definitions
from diffdrive_mpc_extras.campaign.run import read_table
from diffdrive_mpc_extras.proof.proof_file import load_proof, map_runs

SHORT = "name: short\nsegments:\n- {v: 0.4, omega: 0.5, duration: 0.6}\n"
PROOF = """
description: short drives of a model
runs: 20
factors:
  trajectory: short.yaml
  plant: "model:sm"
  scenario: {one_of: [none, start_offset]}
  sensors.pose.latency: {uniform: [0.0, 0.1]}   # s
probe: {factors: {trajectory: short.yaml, plant: "model:sm"}, seeds: [1, 2]}
maps:
  latency-and-noise:
    x: {factor: sensors.pose.latency, low: 0.0, high: 0.3, steps: 2}        # s
    y: {factor: sensors.pose.position_sd, low: 0.001, high: 0.1, steps: 2}  # m
boundaries:
  sensors.pose.latency: {holds: 0.02, beyond: 0.5, within: 0.3, unit: s}
"""


@pytest.fixture
def proof(tmp_path: Path) -> Path:
    return write_proof(tmp_path)


def write_proof(folder: Path) -> Path:
    (folder / "short.yaml").write_text(SHORT, encoding="utf-8")
    path = folder / "proof.yaml"
    path.write_text(PROOF, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def proof_result(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[object, ...]]:
    """Folder of a proof, and the arguments of its command."""
    folder = tmp_path_factory.mktemp("proven")
    args = ("prove", "sm", "--campaign", write_proof(folder), "--out", folder / "out", "--jobs", "1", "--worst", "3")
    call(*args)
    return folder / "out", args


def test_proof_writes_report_table_figures_and_worst_runs(
    proof_result: tuple[Path, tuple[object, ...]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, args = proof_result
    report = (out / "prove.md").read_text(encoding="utf-8")
    for part in ("Outcomes", "Position error", "Unsafe commands", "By scenario", "Boundaries", "Worst runs"):
        assert f"## {part}\n" in report
    assert "0 of 20 runs had an unsafe command: with 95 % confidence, the rate is below 13.9 %" in report
    assert {path.name for path in (out / "figures").iterdir()} == {"errors.png", "map-latency-and-noise.png"}
    page = content_of(out / "report.html")
    assert {view["kind"] for view in page["views"]} == {"chart", "map"}
    table = read_table(out / "prove.parquet").to_pydict()
    assert (len(table["run"]), set(table["model"])) == (20, {"sm"})
    results = json.loads((out / "prove.json").read_text(encoding="utf-8"))
    assert results["rates"]["completed"]["of"] == 20
    assert results["boundaries"][0]["tried"]["0.02"] == 2
    files = sorted((out / "worst").iterdir())
    assert [path.name for path in files] == ["01.yaml", "02.yaml", "03.yaml"]
    # Repeating each of the worst runs from its file gives the same results.
    errors = sorted((error for error in table["position_rmse_m"]), reverse=True)
    errors_of_files = [yaml.safe_load(path.read_text(encoding="utf-8"))["figures"]["position_rmse_m"] for path in files]
    assert errors_of_files == errors[:3]
    output = call("repeat", files[0], "--trust-terms", out.parent, "--log", tmp_path / "worst.csv")
    assert "values are identical to the file" in " ".join(output.split())
    assert (tmp_path / "worst.csv").stat().st_size > 0
    # A repeated proof uses the stored runs and prints the same output.
    monkeypatch.setattr("diffdrive_mpc_extras.campaign.engine.drive", None)
    call(*args)
    body = report.partition("## Outcomes")[2]
    assert (out / "prove.md").read_text(encoding="utf-8").partition("## Outcomes")[2] == body


def test_repeat_reports_a_run_with_different_figures(proof: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    data = yaml.safe_load(proof.read_text(encoding="utf-8"))
    proof.write_text(yaml.safe_dump({key: data[key] for key in ("description", "runs", "factors")}), encoding="utf-8")
    call("prove", "ssm", "--campaign", proof, "--out", out, "--jobs", "1", "--runs", "2", "--worst", "1")
    (path,) = (out / "worst").iterdir()
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    content["figures"]["position_rmse_m"] *= 1.0 + 1e-12
    content["environment"]["numpy"] = "1.0"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    output = " ".join(call("repeat", path, "--trust-terms", tmp_path, code=1).split())
    assert "1 of " in output
    assert "values differ: position_rmse_m is" in output
    assert "changed: numpy (1.0, now" in output


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (
            ("trajectory: short", "model: sm\n  trajectory: short"),
            "factors.model: remove it; the controller under test is ssm",
        ),
        (("low: 0.0, high", "low: 0.4, high"), "low (0.4) must be below high (0.3)"),
    ],
)
def test_invalid_proof_raises_one_line_error(change: tuple[str, str], error: str, proof: Path, tmp_path: Path) -> None:
    text = proof.read_text(encoding="utf-8")
    assert change[0] in text
    proof.write_text(text.replace(*change, 1), encoding="utf-8")
    output = call("prove", "ssm", "--campaign", proof, "--out", tmp_path / "out", code=2)
    assert error in " ".join(output.split())
    assert not (tmp_path / "out").exists()


def test_shipped_proof_can_be_simulated() -> None:
    proof = load_proof(None)
    check_definitions(proof.definitions(64))
    probe = Definition.from_factors(dict(proof.probe.factors))
    ends = [run for proof_map in proof.maps.values() for run in map_runs(proof_map, probe, 0)]
    ends += [
        probe.with_factors({factor: value})
        for factor, search in proof.boundaries.items()
        for value in (search.holds, search.beyond)
    ]
    check_definitions(ends)
    # The seeds of the probe are not among the drawn seeds.
    drawn_seeds = {definition.case.seed for definition in proof.definitions()}
    assert not drawn_seeds & set(proof.probe.seeds)
