"""`models fit` and `models calibrate`: checked before the long work, counted while it goes on."""

from pathlib import Path

import numpy as np
import pytest

from diffdrive_mpc import load_model, make_plant
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.plants.open_loop import OpenLoopDrive, drive_open_loop
from studies.shipped_models.model_fitting import IDENTIFICATIONS, PaperExperiments, fit_models

FITTING = "studies.shipped_models.model_fitting"


def _step(v: float, omega: float) -> OpenLoopDrive:
    commands: FloatArray = np.vstack([np.zeros((10, 2)), np.tile([v, omega], (100, 1))])
    return drive_open_loop(make_plant("model:ssm", surface="ideal", sensors="perfect"), commands)


@pytest.fixture
def quick_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short experiments on a velocity model."""

    straight, turn = [_step(0.5, 0.0)], [_step(0.0, 1.0)]
    monkeypatch.setattr(f"{FITTING}.run_experiments", lambda: PaperExperiments(straight, straight, turn, []))
    monkeypatch.setattr(f"{FITTING}.validation_table", lambda folder: Table("FIT", ("model",), (("sm",),)))


@pytest.mark.usefixtures("quick_parts")
def test_every_identification_is_announced_against_the_right_total(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    fit_models(tmp_path, on_progress=lambda done, total: seen.append((done, total)))
    assert IDENTIFICATIONS == 10
    assert seen == [(k, IDENTIFICATIONS) for k in range(IDENTIFICATIONS + 1)]
    assert load_model(tmp_path / "sm.yaml").order == 4
    assert load_model(tmp_path / "mbm.yaml").order == 8
