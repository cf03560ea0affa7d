"""The public call from logs to a controller, without the command line."""

import numpy as np
import pandas as pd
import pytest
from log_parts import drive, write_csv, write_mapping

from diffdrive_mpc import ConfigError, Controller, identify, load_config, load_model
from diffdrive_mpc.models.identification import Identification
from diffdrive_mpc.models.identification.deliver.configuration import NODE_FILE
from diffdrive_mpc.models.identification.from_logs import FILES


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    write_mapping(folder / "map.yaml")
    for name, seed in (("one", 0), ("two", 1)):
        write_csv(folder / f"{name}.csv", drive(seconds=20.0, seed=seed))
    return folder


@pytest.fixture(scope="module")
def identification(folder):
    return identify([folder / "one.csv"], mapping=folder / "map.yaml", structure="sm", validate=[folder / "two.csv"])


def test_the_model_is_the_robot_and_drives(identification):
    assert np.diag(identification.model.dc_gain) == pytest.approx([1.0, 1.0], abs=0.02)
    assert identification.model.name == "SM from one"
    controller = Controller(load_config(identification.config), model=identification.model)
    assert controller.config.limits.v == identification.config["limits"]["v"]
    assert controller.config.sample_time == pytest.approx(0.02)


def test_what_is_written_is_what_was_found(identification, tmp_path):
    identification.write(tmp_path / "new" / "mine")
    folder = tmp_path / "new" / "mine"
    assert sorted(path.name for path in folder.iterdir()) == sorted(set(FILES) - {NODE_FILE})
    written, held = load_config(folder / "config.yaml"), load_config(identification.config)
    assert written.model_copy(update={"model": held.model}) == held
    assert written.model == str(folder / "model.yaml")
    loaded = load_model(folder / "model.yaml")
    for name in ("A", "B", "C", "dead_time"):
        assert getattr(loaded, name).tolist() == getattr(identification.model, name).tolist()
    identification.write(folder)  # and again, over itself


def test_the_configuration_without_its_model_is_refused_and_not_driven_with_another(
    identification, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"model 'model\.yaml'"):
        Controller(load_config(identification.config))


def test_data_frames_give_the_model_of_their_files(folder, identification):
    logs = [pd.read_csv(folder / f"{name}.csv") for name in ("one", "two")]
    model = identify(logs[0], folder / "map.yaml", "sm", validate=logs[1:]).model
    assert model.name == "SM from data_frame_0"
    assert model.A.tolist() == identification.model.A.tolist()


def test_one_path_is_a_log_and_progress_is_told(folder):
    told, findings = [], []
    one = identify(
        str(folder / "one.csv"),
        str(folder / "map.yaml"),
        fit_share=0.5,
        name="mine",
        on_progress=told.append,
        on_findings=findings.extend,
    )
    assert isinstance(one, Identification)
    assert one.model.name == "mine"
    assert told[0] == "reading"
    assert told[1].startswith("identification")
    assert "the last 50 %" in one.content.provenance.notes
