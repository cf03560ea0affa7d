"""A commissioning that is killed or finds the disk full at any moment, two at once, and other inputs in between."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from crashes import KILLED, REFUSED, crash
from diffdrive_mpc.app.commission import chain, ledger
from diffdrive_mpc.app.commission.commissioning import CommissionRequest, commission
from diffdrive_mpc.app.commission.ledger import Gate
from diffdrive_mpc.bench.report_folder import alone_in
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.whole_file import UNFINISHED
from diffdrive_mpc_extras.excitation.model_excitation import Room

FILES = {
    "excite": ("drive.yaml",),
    "record": ("log.csv",),
    "learn": ("model.yaml", "config.yaml"),
    "identify_all": ("model.yaml", "config.yaml", "first_circle.yaml"),
    "twin": ("plant.yaml",),
    "prove": ("prove.md", "prove.json"),
}
REQUEST = CommissionRequest(Room(5.0, 4.0), "heavy", jobs=1).quick()
OTHER = replace(REQUEST, seed=1)


@pytest.fixture(autouse=True)
def quick_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps that write what the real ones write, from the seed of the drives."""
    monkeypatch.setattr(ledger, "_processor_time", lambda: 0.0)
    for name, files in FILES.items():

        def step(folder: Path, name: str = name, files: tuple[str, ...] = files, **options: object) -> Gate:
            logs, drive = options.get("logs"), options.get("drive")
            given = logs.files[0] if isinstance(logs, chain.Logs) else drive
            text = f"seed {options['seed']}" if "seed" in options else ""
            text = given.read_text(encoding="utf-8") if isinstance(given, Path) else text
            for file in files:
                (folder / file).write_text(f"{name} {text}\nmodel: model.yaml\n", encoding="utf-8")
            return Gate(True, f"{name} is done")

        monkeypatch.setattr(chain, name, step)


def carried_out(request: CommissionRequest, out: Path) -> dict[str, bytes]:
    """Every file that it leaves."""
    assert commission(request, out)
    files = {str(path.relative_to(out)): path for path in sorted(out.rglob("*")) if path.is_file()}
    return {name: path.read_bytes() for name, path in files.items() if UNFINISHED not in name}


def check_crashes(tmp_path: Path, moments: list[int], *, full: bool) -> None:
    quiet = [carried_out(request, tmp_path / f"quiet-{request.seed}") for request in (REQUEST, OTHER)]
    assert quiet[0] != quiet[1]
    codes = []
    for moment in moments:
        out, new = tmp_path / f"out-{moment}", list[str]()
        codes.append(crash(lambda out=out: carried_out(REQUEST, out), out, moment, full=full))
        before = ledger.Ledger(out).steps
        commission(REQUEST, out, on_step=lambda name, _, fresh, new=new: new.append(name) if fresh else None)
        # What was written down as done is not done again.
        assert not set(new) & set(before)
        assert [carried_out(request, out) for request in (OTHER, REQUEST)] == quiet[::-1]
    assert set(codes) == {0, REFUSED if full else KILLED}


@pytest.mark.parametrize("full", [False, True], ids=["killed", "disk full"])
def test_a_commissioning_that_breaks_off_goes_on_and_comes_to_the_same(tmp_path: Path, full: bool) -> None:
    check_crashes(tmp_path, [*range(3, 130, 13), 500], full=full)


@pytest.mark.long
@pytest.mark.parametrize("full", [False, True], ids=["killed", "disk full"])
def test_so_it_does_at_every_moment(tmp_path: Path, full: bool) -> None:
    check_crashes(tmp_path, [*range(1, 200), 500], full=full)


def test_a_second_commissioning_in_a_folder_is_refused_meanwhile(tmp_path: Path) -> None:
    """Each would take what the other one recorded, and write down its own steps alone."""
    with alone_in(tmp_path, tmp_path), pytest.raises(ConfigError, match="another command is writing there"):
        commission(OTHER, tmp_path)
    assert not list(tmp_path.iterdir())
    assert commission(OTHER, tmp_path)
