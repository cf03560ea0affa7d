"""Runs and logs in Rerun: what its own reader finds in the files, and one line where something is missing."""

import sys

import pytest
from typer.testing import CliRunner

from diffdrive_mpc.app import rerun_view
from diffdrive_mpc.app.cli import app

ENTITIES = {
    *(f"/path/{name}" for name in ("reference", "plan", "true", "estimate", "pose")),
    *(f"/speed/{name}" for name in ("v_ref_m_s", "v_wheel_m_s", "estimate_v_m_s", "true_v_m_s")),
    *(f"/yaw_rate/{name}" for name in ("omega_ref_rad_s", "omega_gyro_rad_s", "true_omega_rad_s")),
    *("/error/error_along_m", "/error/error_across_m", "/time/step_time_s", "/time/solve_time_s", "/mode"),
}
WORDS = ["simulate", "--plant", "model:ssm", "--trajectory", "s"]


def run(*words):
    return CliRunner().invoke(app, [*words])


def entities(path):
    """Entities of the recording in a file, and of each how many rows it has, by whichever reader the release has."""
    try:
        from rerun.chunk import RrdReader
    except ImportError:
        from rerun.dataframe import load_recording

        columns = load_recording(str(path)).schema().component_columns()
        return {column.entity_path for column in columns}
    return {str(chunk.entity_path) for chunk in RrdReader(str(path)).stream().to_chunks()}


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rerun")
    done = run(*WORDS, "--rerun", str(folder / "s.rrd"), "--log", str(folder / "s.mcap"))
    assert done.exit_code == 0, done.output
    assert run(*WORDS, "--log", str(folder / "s.csv")).exit_code == 0
    return folder


def test_a_live_view_is_kept_as_a_file(logs):
    assert entities(logs / "s.rrd") >= ENTITIES


@pytest.mark.parametrize(("log", "without"), [("s.mcap", set()), ("s.csv", {"/path/plan"})])
def test_a_log_shows_the_same(logs, log, without, tmp_path):
    done = run("log", "rerun", str(logs / log), "--to", str(tmp_path / "s.rrd"))
    assert done.exit_code == 0 and " ticks" in done.output
    assert entities(tmp_path / "s.rrd") >= ENTITIES - without


def test_a_view_changes_nothing_of_the_run(logs):
    from diffdrive_mpc.models.logs.drive_log.reader import read_drive_log

    watched = read_drive_log(logs / "s.mcap").columns
    plain = rerun_view._logged(logs / "s.csv")[0]
    assert watched["v_ref_m_s"].tolist() == [row["v_ref_m_s"] for row in plain]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([*WORDS, "--rerun", "s.png"], "--rerun s.png: give 'live', or a file that ends in .rrd"),
        ([*WORDS, "--rerun", "live"], "--rerun live: there is no display; give a file: --rerun run.rrd"),
        ([*WORDS, "--laps", "2", "--rerun", "live"], "--rerun: it shows one drive; write the last lap with --log"),
        (["log", "rerun", "nothing.csv", "--to", "s.rrd"], "nothing.csv: cannot be read as a log"),
        (["log", "rerun", "other.csv", "--to", "s.rrd"], "other.csv: is no log of `diffdrive-mpc simulate --log`"),
        (["log", "rerun", "words.csv", "--to", "s.rrd"], "words.csv: cannot be read as a log (could not convert"),
    ],
)
def test_what_cannot_be_shown_is_said_in_one_line(words, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "other.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    (tmp_path / "words.csv").write_text("t_s,v_ref_m_s,mode,message\nnow,2,TRACKING,\n", encoding="utf-8")
    done = run(*words)
    assert done.exit_code == 2
    assert said in done.stderr and done.stderr.count("error: ") == 1
    assert not list(tmp_path.glob("*.rrd"))


def test_without_the_extra_the_remedy_is_said(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    done = run(*WORDS, "--rerun", str(tmp_path / "s.rrd"))
    assert done.exit_code == 1
    assert "error: the package 'rerun' is not installed; install diffdrive-mpc[rerun]" in done.stderr
