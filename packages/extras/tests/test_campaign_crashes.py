"""A campaign that is killed or finds the disk full at any moment, two at once, and other factors in between."""

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
from diffdrive_mpc_extras.campaign.run import needs_arrow, read_table, run_campaign

FILE = 'description: of a test\nruns: 3\nfactors:\n  plant: "model:sm"\n  trajectory: circle\n  config.weights.across: '
MOMENTS = [*Random(5).sample(range(1, 40), 13), 500]


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
    """Two campaigns with runs of other weights."""
    made = tmp_path / "first.yaml", tmp_path / "second.yaml"
    for path, factor in zip(made, ("{uniform: [300, 900]}", "{uniform: [400, 1500]}"), strict=True):
        path.write_text(FILE + factor + "\n", encoding="utf-8")
    return made


def carried_out(file: Path, out: Path) -> object:
    run_campaign(file, CampaignPlace(out, jobs=1))
    return read_table(out / "results.parquet", times=False)


def check_whole(out: Path) -> None:
    """Raise if a file is half-written, as somebody would find it who looks there now."""
    store = Store(out)
    assert None not in map(store.load, store.keys())
    if (out / "results.parquet").exists():
        assert read_table(out / "results.parquet").num_rows == 3


@pytest.mark.parametrize("full", [False, True], ids=["killed", "disk full"])
def test_a_campaign_that_breaks_off_goes_on_and_comes_to_the_same(
    files: tuple[Path, Path], tmp_path: Path, full: bool
) -> None:
    expected = [carried_out(file, tmp_path / f"quiet-{file.stem}") for file in files]
    codes = []
    for moment in MOMENTS:
        out = tmp_path / f"out-{moment}"
        codes.append(crash(lambda out=out: carried_out(files[0], out), out, moment, full=full))
        check_whole(out)
        assert not full or not list(out.rglob(".unfinished*"))
        # Other factors in between, and then what was asked for at first.
        assert [carried_out(file, out) for file in reversed(files)] == expected[::-1]
        assert len(Store(out).keys()) == 6
    assert set(codes) == {0, REFUSED if full else KILLED}


def test_two_campaigns_at_once_on_one_store_lose_nothing(files: tuple[Path, Path], tmp_path: Path) -> None:
    """The same twice, and another one."""
    expected, out = [carried_out(file, tmp_path / f"quiet-{file.stem}") for file in files], tmp_path / "out"
    children = []
    for file in (files[0], files[0], files[1]):
        children.append(os.fork())
        if children[-1] == 0:
            code = 1
            try:
                for _ in range(5):
                    carried_out(file, out)
                code = 0
            finally:
                os._exit(code)
    assert [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children] == [0, 0, 0]
    check_whole(out)
    assert not list(out.rglob(".unfinished*"))
    assert [carried_out(file, out) for file in files] == expected


def forge(path: Path, change: Callable[[dict[str, object]], None]) -> None:
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
def test_forged_figure_is_refused_by_file_run_and_column(
    files: tuple[Path, Path], tmp_path: Path, column: str, change: Callable[[dict[str, object]], None]
) -> None:
    out = tmp_path / "out"
    expected = carried_out(files[0], out)
    path = sorted(out.glob("runs/*/*.json"))[1]
    forge(path, change)
    with pytest.raises(ConfigError) as error:
        carried_out(files[0], out)
    assert all(words in str(error.value) for words in (str(path), path.stem[:12], f"'{column}'"))
    path.unlink()
    assert carried_out(files[0], out) == expected


def test_row_of_another_run_is_refused(files: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    carried_out(files[0], out)
    first, second, _ = sorted(out.glob("runs/*/*.json"))
    second.write_bytes(first.read_bytes())
    with pytest.raises(ConfigError, match=second.stem[:12]):
        carried_out(files[0], out)


def test_full_disk_is_said_with_the_name_of_the_file(
    files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Writing fails after opening; what `os.open` refuses names its file by itself."""
    out = tmp_path / "out"

    def full(*_: object, **__: object) -> None:
        with Path("/dev/full").open("w") as file:
            file.write("x")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", full)
        with pytest.raises(OSError, match=r"No space left on device.*runs/.*\.json"):
            carried_out(files[0], out)
    carried_out(files[0], out)
    (out / "results.parquet").unlink()
    _, parquet = needs_arrow()
    monkeypatch.setattr(parquet, "write_table", full)
    with pytest.raises(OSError, match=r"No space left on device.*results\.parquet"):
        carried_out(files[0], out)
    assert not (out / "results.parquet").exists()
    assert not list(out.rglob(".unfinished*"))
