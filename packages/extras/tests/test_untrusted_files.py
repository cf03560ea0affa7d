"""Untrusted files of campaigns, proofs, plans and drives: files that they name are neither opened nor run."""

import json
import pickle
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from diffdrive_mpc import Measurement, load_config
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build
from diffdrive_mpc.models.logs.tick_record import DriveRecord, TickRecord
from diffdrive_mpc.models.trust import UntrustedFileError
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.log_mcap import write_log
from diffdrive_mpc_extras.campaign.engine import Store
from diffdrive_mpc_extras.replay.node_log import LoggedConfigs, recorded_drive
from untrusted_files import SHORT, call, write_untrusted_files


@pytest.fixture
def stranger(tmp_path):
    """Folder of untrusted files."""
    folder = write_untrusted_files(tmp_path / "stranger")
    (folder / "costs.yaml").write_text("vehicle: fsu_bot\n")
    return folder


def run_file(folder, factors):
    path = folder / "run.yaml"
    stored = {"run": "0", "factors": {"plant": "model:ssm", **factors}, "figures": {}, "environment": {}}
    path.write_text(yaml.safe_dump(stored))
    return path


FACTORS = {
    "trajectory": {"trajectory": "@/short.yaml"},
    "configuration": {"config": "@/config.yaml"},
    "model": {"model": "@/model.yaml"},
    "model of the plant": {"plant": "model:@/model.yaml+0.02"},
    "robot": {"plant": "mujoco:@/short.yaml"},
    "surface": {"surface": "@/short.yaml"},
    "sensors": {"sensors": "@/short.yaml"},
    "scenario": {"scenario": "@/short.yaml"},
    "world": {"plant": "world:@/short.yaml"},
    "value of the configuration": {"config.model": "@/model.yaml"},
    "turn costs": {"config.expert.energy.turn_costs": "@/costs.yaml", "config.expert.energy.weight": 0.1},
}


@pytest.mark.parametrize("name", FACTORS)
def test_files_that_a_run_file_names_are_neither_opened_nor_run(name, stranger, tmp_path):
    factors = json.loads(json.dumps(FACTORS[name]).replace("@", str(stranger)))
    code, printed, files = call("repeat", run_file(tmp_path, factors))
    assert code == 2 and f"--trust-terms {stranger}" in printed, printed
    assert not [path for path in files if stranger in path.parents]
    assert not (stranger / "marker").exists()


@pytest.mark.parametrize(
    "factors",
    [
        {"controller": "stranger_code:run"},
        {"config.terms": "[{file: @/term.py, function: run}]"},
        {"config.solver.method": "@/code.so"},
    ],
)
def test_names_of_code_in_a_run_file_import_nothing(factors, stranger, tmp_path):
    call("repeat", run_file(tmp_path, json.loads(json.dumps(factors).replace("@", str(stranger)))))
    assert not (stranger / "marker").exists()
    assert "stranger_code" not in sys.modules


def test_run_file_may_name_files_of_a_trusted_folder(stranger, tmp_path):
    factors = {"trajectory": str(stranger / "short.yaml"), "config": str(stranger / "config.yaml")}
    code, printed, _ = call("repeat", run_file(tmp_path, factors), "--trust-terms", stranger)
    assert code == 0, printed
    assert (stranger / "marker").exists()


@pytest.mark.parametrize(
    "command",
    [
        "repeat FILE",
        "campaign FILE --out OUT",
        "prove ssm --campaign FILE --out OUT",
        "plan --from 0,0,0 --to 1,0,0 --costs FILE --out OUT",
    ],
)
def test_yaml_tags_make_no_objects(command, tmp_path):
    (tmp_path / "file.yaml").write_text(f"name: !!python/object/apply:os.mkdir ['{tmp_path}/marker']\n")
    places = {"FILE": tmp_path / "file.yaml", "OUT": tmp_path / "out"}
    code, printed, _ = call(*(places.get(word, word) for word in command.split()))
    assert code == 2 and printed.startswith("error: "), printed
    assert not (tmp_path / "marker").exists()


class MakesFolder:
    """Unpickled, it makes a folder."""

    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return Path.mkdir, (self.folder / "marker",)


def test_store_ignores_files_that_are_no_rows(tmp_path):
    key = "0" * 64
    place = tmp_path / "runs" / "00" / f"{key}.json"
    place.parent.mkdir(parents=True)
    hostile = json.dumps({"row": {"py/reduce": ["os.mkdir", f"{tmp_path}/marker"]}}).encode()
    for content in (hostile, pickle.dumps({"row": MakesFolder(tmp_path)}), b"[" * 100_000, b"[1]"):
        place.write_bytes(content)
        place.with_suffix(".pkl").write_bytes(content)
        assert Store(tmp_path).load(key) is None
    assert not (tmp_path / "marker").exists()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("path") / "short.yaml"
    path.write_text(SHORT)
    return simulate(*build(Case(plant="model:ssm", trajectory=str(path))))


def configuration(folder, changes):
    """Return values of a logged configuration; '@' is the stranger's folder."""
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
