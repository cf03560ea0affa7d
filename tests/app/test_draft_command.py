"""`identify --draft-mapping`: a file beside the user that is never replaced, and what the log says to it."""

from log_parts import drive, write_csv
from typer.testing import CliRunner

from diffdrive_mpc.app.cli import app

COLUMNS = drive(seconds=8.0)


def run(*words):
    return CliRunner().invoke(app, ["identify", "--draft-mapping", *(str(word) for word in words)])


def test_a_draft_is_written_where_the_user_stands_and_is_never_replaced(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    log = write_csv(tmp_path / "log.csv", COLUMNS | {"gyro": -COLUMNS["gyro"]})
    shown = run("log.csv").stdout
    draft = tmp_path / "mapping.yaml"
    assert draft.read_text() in shown
    assert "omega of the gyro runs against the command" in shown
    assert shown.endswith("Next: correct mapping.yaml, then diffdrive-mpc identify log.csv --mapping mapping.yaml\n")
    draft.write_text("corrected by hand")
    refused = run("log.csv")
    assert refused.exit_code == 2
    assert "mapping.yaml: exists and is not replaced; move it away, or give --out" in refused.stderr
    assert draft.read_text() == "corrected by hand"
    assert run(log, "--out", "mine/map.yaml").exit_code == 0
    assert (tmp_path / "mine/map.yaml").is_file()
    assert "--draft-mapping: 2 logs; give one" in run(log, log).stderr
