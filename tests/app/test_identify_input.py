"""Invalid logs and options give one line and exit code 2, and leave no files."""

import shlex

import numpy as np
import pytest
from log_parts import MAPPING, drive, write_csv, write_mapping

from commands import invoke
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.app.identification import study, trial_drives
from diffdrive_mpc.bench.report_folder import CONTENTS

COLUMNS = drive(seconds=12.0)
CODE_IN_YAML = "!!python/object/apply:os.system ['touch {folder}/executed']\n"


@pytest.fixture(autouse=True, scope="module")
def bare_results():
    """Replace figures by an empty file and run one trial drive; test_identify_command.py covers all of them."""

    def draw_nothing(report, folder, on_done):
        (folder / "figures").mkdir()
        (folder / "figures" / "none.png").touch()
        return {}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "draw_identification", draw_nothing)
        patch.setattr(trial_drives, "PATHS", ("circle",))
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Logs with mistakes."""
    folder = tmp_path_factory.mktemp("logs")
    write_mapping(folder / "map.yaml")
    write_mapping(folder / "no_pose.yaml", MAPPING.replace("  pose: {x: x, y: y, theta: theta}\n", ""))
    write_mapping(folder / "evil.yaml", CODE_IN_YAML.format(folder=folder))
    logs = {
        "good": COLUMNS,
        "copy": COLUMNS,
        "missing": {name: column for name, column in COLUMNS.items() if name != "gyro"},
        "degrees": COLUMNS | {"gyro": np.degrees(COLUMNS["gyro"])},
        "short": {name: column[:30] for name, column in COLUMNS.items()},
        "nan": COLUMNS | {"v_ref": np.full(600, np.nan)},
        "slow": COLUMNS | {"t": 50.0 * COLUMNS["t"]},
        "reversed": COLUMNS | {"gyro": -COLUMNS["gyro"]},
    }
    for name, columns in logs.items():
        write_csv(folder / f"{name}.csv", columns)
    (folder / "evil.csv").write_text(CODE_IN_YAML.format(folder=folder))
    return folder


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("missing.csv --mapping map.yaml", "column 'gyro' is missing"),
        ("nan.csv --mapping map.yaml", "nan.csv: column 'v_ref' holds no usable number"),
        ("slow.csv --mapping no_pose.yaml", "slow.csv: sample_time: Input should be less than or equal to 0.5 (found"),
        ("good.csv", "are unknown without a mapping. Give a mapping file"),
        ("good.csv --mapping evil.yaml", "evil.yaml"),
        ("evil.csv", "evil.csv"),
        ("good.csv --mapping map.yaml --structure smm", "--structure 'smm': give one of mbm, sm, ssm"),
        ("good.csv --mapping map.yaml --validate copy.csv", "copy.csv: this log is given twice"),
        ("short.csv --mapping map.yaml", "short.csv: v was hardly driven"),
    ],
)
def test_invalid_input_gives_one_line_and_exit_code_2(arguments, message, folder, tmp_path, monkeypatch):
    monkeypatch.chdir(folder)
    files = sorted(folder.rglob("*"))
    line = invoke(app, "identify", "--out", tmp_path / "out", *shlex.split(arguments), code=2).stderr
    assert line.startswith("error: ") and line.count("\n") == 1 and message in line
    assert not (tmp_path / "out").exists()
    assert sorted(folder.rglob("*")) == files  # no file was executed


@pytest.mark.parametrize("name", [pytest.param("degrees", marks=pytest.mark.long), "reversed"])
def test_refused_log_leaves_only_a_corrected_mapping(name, folder, tmp_path):
    arguments = ["identify", folder / f"{name}.csv", "--out", tmp_path / "out", "--mapping"]
    result = invoke(app, *arguments, folder / "map.yaml", code=2)
    assert result.stderr.count("error: ") == 1 and f"error: {name}.csv: omega of the gyro" in result.stderr
    assert f"--mapping {tmp_path / 'out' / 'fixed.yaml'}" in result.stderr
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["fixed.yaml"]
    invoke(app, *arguments, tmp_path / "out" / "fixed.yaml")
    assert (tmp_path / "out" / "fixed.yaml").exists(), "the mapping is an input, so it must remain"


def test_contradictory_log_gives_a_configuration_only_by_force(folder, tmp_path):
    log = write_csv(tmp_path / "rpm.csv", COLUMNS | {"v": 60 / (2 * np.pi) * COLUMNS["v"]})
    arguments = ["identify", log, "--mapping", folder / "map.yaml", "--out", tmp_path / "o"]
    assert "v of the encoders is 9.2" in invoke(app, *arguments, code=2).stderr
    assert not (tmp_path / "o").exists()
    invoke(app, *arguments, "--force")
    assert (tmp_path / "o" / "config.yaml").exists()
    assert "May I drive? No: " in (tmp_path / "o" / "report.md").read_text()


@pytest.mark.system
def test_negative_fit_writes_only_the_report(folder, tmp_path):
    """The robot of the held-out log has a quarter of the yaw rate, so no model of the first log predicts its motion."""
    log = write_csv(tmp_path / "one.csv", COLUMNS)
    validation = write_csv(tmp_path / "other.csv", COLUMNS | {"gyro": 0.25 * COLUMNS["gyro"]})
    arguments = ["identify", log, "--validate", validation, "--mapping", folder / "map.yaml", "--out", tmp_path / "o"]
    result = invoke(app, *arguments, code=2)
    assert "at least 40 %" in result.stderr and "--force" in result.stderr
    files = [CONTENTS, "report.html", "report.json", "report.md"]
    assert sorted(path.name for path in (tmp_path / "o").iterdir() if path.is_file()) == files
    invoke(app, *arguments, "--force")
    assert (tmp_path / "o" / "config.yaml").exists()


DRAFT_COLUMNS = drive(seconds=8.0)


def draft(*arguments, code=0):
    return invoke(app, "identify", "--draft-mapping", *arguments, code=code)


def test_draft_mapping_is_written_to_the_working_folder_and_never_replaced(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    log = write_csv(tmp_path / "log.csv", DRAFT_COLUMNS | {"gyro": -DRAFT_COLUMNS["gyro"]})
    output = draft("log.csv").stdout
    mapping = tmp_path / "mapping.yaml"
    assert mapping.read_text() in output
    assert "omega of the gyro has the opposite sign to the command" in output
    assert output.endswith("Next: correct mapping.yaml, then diffdrive-mpc identify log.csv --mapping mapping.yaml\n")
    mapping.write_text("corrected by hand")
    error = draft("log.csv", code=2).stderr
    assert "mapping.yaml: the file exists and is not replaced; move it, or pass --out" in error
    assert mapping.read_text() == "corrected by hand"
    draft(log, "--out", "mine/map.yaml")
    assert (tmp_path / "mine/map.yaml").is_file()
    assert "--draft-mapping: 2 logs; pass one" in draft(log, log, code=2).stderr
