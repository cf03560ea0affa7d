"""`models fit` and `models calibrate`: checked before the long work, counted while it goes on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from commands import invoke
from diffdrive_mpc import load_model, make_plant
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.plants.open_loop import OpenLoopDrive, drive_open_loop
from studies.cli import app
from studies.shipped_models.model_fitting import IDENTIFICATIONS, PaperExperiments, fit_models

FITTING = "studies.shipped_models.model_fitting"


def _step(v: float, omega: float) -> OpenLoopDrive:
    commands: FloatArray = np.vstack([np.zeros((10, 2)), np.tile([v, omega], (100, 1))])
    return drive_open_loop(make_plant("model:ssm", surface="ideal", sensors="perfect"), commands)


@pytest.fixture
def quick_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short experiments on a velocity model."""

    straight, turn = [_step(0.5, 0.0)], [_step(0.0, 1.0)]
    monkeypatch.setattr(
        f"{FITTING}.run_experiments",
        lambda: PaperExperiments(straight, straight, turn),
    )
    monkeypatch.setattr(
        f"{FITTING}.validation_table",
        lambda folder: Table("FIT", ("model",), (("sm",),)),
    )


@pytest.fixture
def no_long_work(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise AssertionError("the long work began")

    monkeypatch.setattr(f"{FITTING}.run_experiments", fails)
    monkeypatch.setattr("studies.shipped_models.calibration._drive", fails)


@pytest.mark.usefixtures("quick_parts")
def test_every_identification_is_announced_against_the_right_total(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    fit_models(tmp_path, on_progress=lambda done, total: seen.append((done, total)))
    assert IDENTIFICATIONS == 10
    assert seen == [(k, IDENTIFICATIONS) for k in range(IDENTIFICATIONS + 1)]
    assert load_model(tmp_path / "sm.yaml").order == 4
    assert load_model(tmp_path / "mbm.yaml").order == 8


@pytest.mark.usefixtures("quick_parts")
def test_an_interrupted_fit_leaves_the_old_files(tmp_path: Path) -> None:
    (tmp_path / "sm.yaml").write_text("old")

    def interrupt(done: int, total: int) -> None:
        if done == total:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_models(tmp_path, on_progress=interrupt)
    assert [path.name for path in tmp_path.iterdir()] == ["sm.yaml"]
    assert (tmp_path / "sm.yaml").read_text() == "old"


@pytest.mark.usefixtures("no_long_work")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("models fit --out {taken}", "cannot be written to"),
        ("models calibrate --out {folder}", "not a regular file"),
        ("models calibrate --out {taken}/firmware.yaml", "cannot be written to"),
        ("models calibrate --check --out {folder}/new.yaml", "--check writes nothing"),
    ],
)
def test_what_cannot_be_written_is_said_before_the_long_work(arguments: str, message: str, tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.write_text("a file")
    result = invoke(app, *arguments.format(taken=taken, folder=tmp_path).split(), code=2)
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1
    assert message in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]
