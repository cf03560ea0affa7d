"""A log or a bag from a stranger: no file that it names is opened, and no code of it runs."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from diffdrive_mpc import ConfigError, Controller, Measurement, load_config
from diffdrive_mpc.app.replay.node_log import LoggedConfigs, recorded_drive
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build
from diffdrive_mpc.models.logs.tick_record import DriveRecord, TickRecord
from diffdrive_mpc.models.trust import UntrustedFileError
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.log_mcap import write_log
from untrusted_files import SHORT, call, write_untrusted_files


@pytest.fixture
def stranger(tmp_path):
    """A folder of files that nobody has looked at."""
    return write_untrusted_files(tmp_path / "stranger")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("path") / "short.yaml"
    path.write_text(SHORT)
    return simulate(*build(Case(plant="model:ssm", trajectory=str(path))))


def configuration(folder, changes):
    """Values of a logged configuration; '@' stands for the stranger's folder."""
    return load_config("ssm").model_dump(mode="json") | json.loads(json.dumps(changes).replace("@", str(folder)))


def mcap(run, path, config, model=""):
    metadata = {
        "case": {"plant": "mujoco"},
        "configuration": {"yaml": yaml.safe_dump(config)},
        "model": {"yaml": model},
    }
    write_log(run, path, metadata)
    return path


NAMED = {
    "a term": ({"terms": [{"file": "@/term.py", "function": "slow"}]}, ""),
    "a model": ({"model": "@/model.yaml"}, ""),
}


@pytest.mark.parametrize("name", NAMED)
def test_files_that_a_log_names_are_neither_opened_nor_run(name, run, stranger, tmp_path):
    changes, model = NAMED[name]
    config = configuration(stranger, changes)
    log = mcap(run, tmp_path / "odd.mcap", config, model)
    code, printed, files = call("log", "replay", log)
    assert code == 2 and f"--trust-terms {stranger}" in printed
    # With a configuration of the user's own the log's is not needed.
    code, printed, more = call("log", "replay", log, "--model", "ssm")
    assert code == 0, printed
    assert not [path for path in files + more if stranger in path.parents]
    assert not (stranger / "marker").exists()
    # Ticks of the node, in a bag or its MCAP, are read in one place.
    tick = TickRecord(1, 0.0, 1, Measurement(), None, np.zeros(2), "TRACKING", "", "none", 0.0)
    drive = DriveRecord(1, True, True, 0.0, None, config, model)
    with pytest.raises(UntrustedFileError, match="odd.bag names"):
        configs = LoggedConfigs(Path("odd.bag"), tmp_path / "scratch")
        recorded_drive(Path("odd.bag"), [tick.line()], [drive.line()], configs)


def test_log_may_name_files_of_a_trusted_folder(run, stranger, tmp_path):
    log = mcap(run, tmp_path / "mine.mcap", configuration(stranger, NAMED["a term"][0]))
    code, printed, _ = call("log", "replay", log, "--trust-terms", stranger)
    assert code == 0, printed
    assert (stranger / "marker").exists()
    # A link out of it leads to another folder.
    (stranger / "inside").mkdir()
    (stranger / "inside" / "term.py").symlink_to(stranger / "term.py")
    linked = configuration(stranger, {"terms": [{"file": "@/inside/term.py", "function": "slow"}]})
    log = mcap(run, tmp_path / "linked.mcap", linked)
    code, printed, _ = call("log", "replay", log, "--trust-terms", stranger / "inside")
    assert code == 2 and "neither opened nor run" in printed


@pytest.mark.parametrize("error", ["SystemExit", "SystemExit(0)", "GeneratorExit", "type('Own', (BaseException,), {})"])
def test_term_that_exits_is_refused_with_one_line(error, stranger):
    (stranger / "term.py").write_text(f"raise {error}\n")
    code, printed, _ = call("simulate", "--config", stranger / "config.yaml", "--plant", "model:ssm")
    assert code == 2 and f"{stranger}/term.py: running it ends with" in printed, printed
    with pytest.raises(ConfigError, match="running it ends with"):
        Controller(load_config(stranger / "config.yaml"))


def test_config_check_names_the_python_of_terms_and_does_not_run_it(stranger):
    code, output, _ = call("config", "check", stranger / "config.yaml")
    assert (code, (stranger / "marker").exists()) == (0, False)
    assert f"not run here: {stranger / 'term.py'}" in output
    (stranger / "term.py").unlink()
    code, output, _ = call("config", "check", stranger / "config.yaml")
    assert code == 2 and "no such Python file" in output
