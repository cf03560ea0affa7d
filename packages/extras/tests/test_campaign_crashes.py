"""Campaigns that are killed or run out of disk space at any time, concurrent campaigns, and alternating factors."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest
from crashes import KILLED, REFUSED, crash

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc_extras.campaign import engine
from diffdrive_mpc_extras.campaign.definition import Definition
from diffdrive_mpc_extras.campaign.drive import Row
from diffdrive_mpc_extras.campaign.engine import CampaignPlace, Store
from diffdrive_mpc_extras.campaign.run import import_arrow, read_table, run_campaign

FILE = 'description: of a test\nruns: 3\nfactors:\n  plant: "model:sm"\n  trajectory: circle\n  config.weights.across: '
CALL_COUNTS = [*Random(5).sample(range(1, 40), 13), 500]


@pytest.fixture(autouse=True)
def quick_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    def drive(definition: Definition) -> Row:
        across = dict(definition.case.overrides)["weights.across"]
        return {
            "completed": True,
            "error": "",
            "square": float(str(across)) ** 2,
            "time_processor_s": time.process_time(),
        }

    monkeypatch.setattr(engine, "drive", drive)
    monkeypatch.setattr(engine, "check_definitions", lambda _: None)


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """Two campaign files with different weights."""
    paths = tmp_path / "first.yaml", tmp_path / "second.yaml"
    for path, factor in zip(paths, ("{uniform: [300, 900]}", "{uniform: [400, 1500]}"), strict=True):
        path.write_text(FILE + factor + "\n", encoding="utf-8")
    return paths


def campaign_table(file: Path, out: Path) -> object:
    run_campaign(file, CampaignPlace(out, jobs=1))
    return read_table(out / "results.parquet", times=False)


def check_complete(out: Path) -> None:
    """Check that no row and no table is half-written."""
    store = Store(out)
    assert None not in map(store.load, store.keys())
    if (out / "results.parquet").exists():
        assert read_table(out / "results.parquet").num_rows == 3


@pytest.mark.parametrize("full", [False, True], ids=["killed", "disk full"])
def test_interrupted_campaign_continues_to_the_same_table(files: tuple[Path, Path], tmp_path: Path, full: bool) -> None:
    expected = [campaign_table(file, tmp_path / f"quiet-{file.stem}") for file in files]
    codes = []
    for call_count in CALL_COUNTS:
        out = tmp_path / f"out-{call_count}"
        codes.append(crash(lambda out=out: campaign_table(files[0], out), out, call_count, full=full))
        check_complete(out)
        assert not full or not list(out.rglob(".unfinished*"))
        # Run the second campaign in between, and then repeat the first.
        assert [campaign_table(file, out) for file in reversed(files)] == expected[::-1]
        assert len(Store(out).keys()) == 6
    assert set(codes) == {0, REFUSED if full else KILLED}


def test_concurrent_campaigns_share_one_store_without_loss(files: tuple[Path, Path], tmp_path: Path) -> None:
    """Run one campaign twice and another campaign once, all at the same time."""
    expected, out = [campaign_table(file, tmp_path / f"quiet-{file.stem}") for file in files], tmp_path / "out"
    children = []
    for file in (files[0], files[0], files[1]):
        children.append(os.fork())
        if children[-1] == 0:
            code = 1
            try:
                for _ in range(5):
                    campaign_table(file, out)
                code = 0
            finally:
                os._exit(code)
    assert [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children] == [0, 0, 0]
    check_complete(out)
    assert not list(out.rglob(".unfinished*"))
    assert [campaign_table(file, out) for file in files] == expected


def modify_row(path: Path, change: Callable[[dict[str, object]], None]) -> None:
    record = json.loads(path.read_text(encoding="utf-8"))
    change(record["row"])
    path.write_text(json.dumps(record), encoding="utf-8")


@pytest.mark.parametrize(
    ("column", "change"),
    [
        ("square", lambda row: row.update(square=-1.0)),
        ("square", lambda row: row.update(square=math.nan)),
        ("completed", lambda row: row.update(completed=False)),
        ("lateral", lambda row: row.update(lateral=0.0)),
        ("square", lambda row: row.pop("square")),
    ],
)
def test_error_of_a_forged_value_names_file_run_and_column(
    files: tuple[Path, Path], tmp_path: Path, column: str, change: Callable[[dict[str, object]], None]
) -> None:
    out = tmp_path / "out"
    expected = campaign_table(files[0], out)
    path = sorted(out.glob("runs/*/*.json"))[1]
    modify_row(path, change)
    with pytest.raises(ConfigError) as error:
        campaign_table(files[0], out)
    assert all(text in str(error.value) for text in (str(path), path.stem[:12], f"'{column}'"))
    path.unlink()
    assert campaign_table(files[0], out) == expected


def test_row_of_another_run_is_rejected(files: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    campaign_table(files[0], out)
    first, second, _ = sorted(out.glob("runs/*/*.json"))
    second.write_bytes(first.read_bytes())
    with pytest.raises(ConfigError, match=second.stem[:12]):
        campaign_table(files[0], out)


def test_error_of_a_full_disk_names_the_file(
    files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Writing fails after the file is opened; errors of `os.open` already name the file."""
    out = tmp_path / "out"

    def write_to_full_disk(*_: object, **__: object) -> None:
        with Path("/dev/full").open("w") as file:
            file.write("x")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", write_to_full_disk)
        with pytest.raises(OSError, match=r"No space left on device.*runs/.*\.json"):
            campaign_table(files[0], out)
    campaign_table(files[0], out)
    (out / "results.parquet").unlink()
    _, parquet = import_arrow()
    monkeypatch.setattr(parquet, "write_table", write_to_full_disk)
    with pytest.raises(OSError, match=r"No space left on device.*results\.parquet"):
        campaign_table(files[0], out)
    assert not (out / "results.parquet").exists()
    assert not list(out.rglob(".unfinished*"))
