"""Untrusted campaigns, proofs, plans and logs: files that they name are neither opened nor run."""

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
def untrusted(tmp_path):
    """Return a folder with untrusted files."""
    folder = write_untrusted_files(tmp_path / "untrusted")
    (folder / "costs.yaml").write_text("vehicle: fsu_bot\n")
    return folder


def run_file(folder, factors):
    path = folder / "run.yaml"
    content = {"run": "0", "factors": {"plant": "model:ssm", **factors}, "figures": {}, "environment": {}}
    path.write_text(yaml.safe_dump(content))
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
def test_untrusted_files_of_a_run_file_are_neither_opened_nor_run(name, untrusted, tmp_path):
    factors = json.loads(json.dumps(FACTORS[name]).replace("@", str(untrusted)))
    code, output, files = call("repeat", run_file(tmp_path, factors))
    assert code == 2 and f"--trust-terms {untrusted}" in output, output
    assert not [path for path in files if untrusted in path.parents]
    assert not (untrusted / "marker").exists()


@pytest.mark.parametrize(
    "factors",
    [
        {"controller": "stranger_code:run"},
        {"config.terms": "[{file: @/term.py, function: run}]"},
        {"config.solver.method": "@/code.so"},
    ],
)
def test_code_names_in_a_run_file_are_not_imported(factors, untrusted, tmp_path):
    call("repeat", run_file(tmp_path, json.loads(json.dumps(factors).replace("@", str(untrusted)))))
    assert not (untrusted / "marker").exists()
    assert "stranger_code" not in sys.modules


def test_run_file_may_name_files_of_a_trusted_folder(untrusted, tmp_path):
    factors = {"trajectory": str(untrusted / "short.yaml"), "config": str(untrusted / "config.yaml")}
    code, output, _ = call("repeat", run_file(tmp_path, factors), "--trust-terms", untrusted)
    assert code == 0, output
    assert (untrusted / "marker").exists()


@pytest.mark.parametrize(
    "command",
    [
        "repeat FILE",
        "campaign FILE --out OUT",
        "prove ssm --campaign FILE --out OUT",
        "plan --from 0,0,0 --to 1,0,0 --costs FILE --out OUT",
    ],
)
def test_yaml_tags_do_not_create_objects(command, tmp_path):
    (tmp_path / "file.yaml").write_text(f"name: !!python/object/apply:os.mkdir ['{tmp_path}/marker']\n")
    paths = {"FILE": tmp_path / "file.yaml", "OUT": tmp_path / "out"}
    code, output, _ = call(*(paths.get(argument, argument) for argument in command.split()))
    assert code == 2 and output.startswith("error: "), output
    assert not (tmp_path / "marker").exists()


class PickledCommand:
    """Object that creates a folder when it is unpickled."""

    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return Path.mkdir, (self.folder / "marker",)


def test_store_ignores_files_that_are_not_rows(tmp_path):
    key = "0" * 64
    path = tmp_path / "runs" / "00" / f"{key}.json"
    path.parent.mkdir(parents=True)
    hostile = json.dumps({"row": {"py/reduce": ["os.mkdir", f"{tmp_path}/marker"]}}).encode()
    for content in (hostile, pickle.dumps({"row": PickledCommand(tmp_path)}), b"[" * 100_000, b"[1]"):
        path.write_bytes(content)
        path.with_suffix(".pkl").write_bytes(content)
        assert Store(tmp_path).load(key) is None
    assert not (tmp_path / "marker").exists()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("path") / "short.yaml"
    path.write_text(SHORT)
    return simulate(*build(Case(plant="model:ssm", trajectory=str(path))))


def configuration(folder, changes):
    """Return values of a logged configuration; '@' stands for the untrusted folder."""
    return load_config("ssm").model_dump(mode="json") | json.loads(json.dumps(changes).replace("@", str(folder)))


def write_mcap(run, path, config, model=""):
    metadata = {
        "case": {"plant": "mujoco"},
        "configuration": {"yaml": yaml.safe_dump(config)},
        "model": {"yaml": model},
    }
    write_log(run, path, metadata)
    return path


NAMED_FILES = {
    "a term": ({"terms": [{"file": "@/term.py", "function": "slow"}]}, ""),
    "a model": ({"model": "@/model.yaml"}, ""),
}


@pytest.mark.parametrize("name", NAMED_FILES)
def test_untrusted_files_of_a_log_are_neither_opened_nor_run(name, run, untrusted, tmp_path):
    changes, model = NAMED_FILES[name]
    config = configuration(untrusted, changes)
    log = write_mcap(run, tmp_path / "log.mcap", config, model)
    code, output, files = call("log", "replay", log)
    assert code == 2 and f"--trust-terms {untrusted}" in output
    # A configuration of the user replaces the configuration in the log.
    code, output, files_with_model = call("log", "replay", log, "--model", "ssm")
    assert code == 0, output
    assert not [path for path in files + files_with_model if untrusted in path.parents]
    assert not (untrusted / "marker").exists()
    # The same function reads ticks of the node from bags and MCAP logs.
    tick = TickRecord(1, 0.0, 1, Measurement(), None, np.zeros(2), "TRACKING", "", "none", 0.0)
    drive = DriveRecord(1, True, True, 0.0, None, config, model)
    with pytest.raises(UntrustedFileError, match="odd.bag names"):
        configs = LoggedConfigs(Path("odd.bag"), tmp_path / "scratch")
        recorded_drive(Path("odd.bag"), [tick.line()], [drive.line()], configs)


def test_log_may_name_files_of_a_trusted_folder(run, untrusted, tmp_path):
    log = write_mcap(run, tmp_path / "log.mcap", configuration(untrusted, NAMED_FILES["a term"][0]))
    code, output, _ = call("log", "replay", log, "--trust-terms", untrusted)
    assert code == 0, output
    assert (untrusted / "marker").exists()
    # A symbolic link to another folder is not trusted.
    (untrusted / "inside").mkdir()
    (untrusted / "inside" / "term.py").symlink_to(untrusted / "term.py")
    linked_config = configuration(untrusted, {"terms": [{"file": "@/inside/term.py", "function": "slow"}]})
    log = write_mcap(run, tmp_path / "linked.mcap", linked_config)
    code, output, _ = call("log", "replay", log, "--trust-terms", untrusted / "inside")
    assert code == 2 and "neither opened nor run" in output
