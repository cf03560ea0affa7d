"""Files of campaigns, proofs and plans from a stranger: no file that they name is opened, and no code of it runs."""

import json
import pickle
import sys
from pathlib import Path

import pytest
import yaml

from diffdrive_mpc_extras.campaign.engine import Store
from untrusted_files import call, write_untrusted_files


@pytest.fixture
def stranger(tmp_path):
    """A folder of files that nobody has reviewed."""
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
