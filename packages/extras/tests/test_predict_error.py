"""`predict-error`: figure, numbers, the worst place with its reason; and mistakes in one line."""

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from diffdrive_mpc.app.cli import app
from diffdrive_mpc_extras.predicted_error.calibration import load_calibration


def invoke(*words):
    return CliRunner().invoke(app, ["predict-error", *map(str, words)])


def test_it_prints_widths_and_reasons_and_writes_figure_and_rows(tmp_path):
    result = invoke("--trajectory", "s", "--population", "own", "--out", tmp_path)
    assert result.exit_code == 0, result.output
    assert "lateral: worst after" in result.output
    assert "along: worst after" in result.output
    assert (tmp_path / "predicted-error.png").read_bytes().startswith(b"\x89PNG")
    rows = np.genfromtxt(tmp_path / "predicted-error.csv", delimiter=",", names=True)
    assert (rows["lateral_everywhere"] > rows["lateral"]).all()
    assert rows["s"][-1] == pytest.approx(6.28, abs=0.01)
    assert f"{1e3 * rows['lateral_everywhere'].max():.1f}" in result.output


def test_a_calibration_of_ones_own_counts(tmp_path):
    shipped = load_calibration()
    mine = shipped.populations["own"].model_copy(update={"description": "drives of my twin"})
    data = shipped.model_copy(update={"populations": {"mine": mine}}).model_dump(mode="json")
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(data))
    words = ["--trajectory", "s", "--calibration", tmp_path / "mine.yaml", "--out", tmp_path]
    result = invoke(*words, "--population", "mine")
    assert result.exit_code == 0, result.output
    assert "drives of my twin" in result.output
    assert "unknown population 'drawn': give mine" in invoke(*words).output


def test_a_path_faster_than_the_calibration_gets_one_line_of_warning(tmp_path):
    result = invoke("--trajectory", "figure8", "--out", tmp_path)
    assert result.exit_code == 0, result.output
    (line,) = [line for line in result.output.splitlines() if line.startswith("warning:")]
    assert "speed reaches 1.2 m/s" in line
    assert "yaw rate reaches 1.1 rad/s" in line
    assert "warning:" not in invoke("--trajectory", "s", "--out", tmp_path).output


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--trajectory", "s", "--config", "kinematic"], "provenance.origin is assumed"),
        (["--trajectory", "s", "--config", "p2_physical"], "lag of v is 0.0613 s; errors are predicted for 0.108"),
        (["--trajectory", "nowhere"], "unknown trajectory 'nowhere'"),
        (["--trajectory", "s", "--population", "mine"], "unknown population 'mine': give drawn or own"),
        (["--trajectory", "s", "--calibration", "nan.csv"], "nan.csv"),
        (["--trajectory", "s", "--calibration", "nowhere.yaml"], "nowhere.yaml"),
        (["--trajectory", "s", "--config", "nothing"], "unknown configuration 'nothing'"),
        (["--trajectory", "empty.csv"], "empty.csv"),
        (["--trajectory", "nan.csv"], "nan.csv"),
    ],
)
def test_mistakes_end_in_one_line(tmp_path, monkeypatch, words, complaint):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.csv").write_text("t,x,y,theta\n")
    (tmp_path / "nan.csv").write_text("t,x,y,theta\n0,0,0,0\n1,nan,0,0\n2,1,0,0\n")
    result = invoke(*words, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert complaint in result.output
    assert len(result.output.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()
