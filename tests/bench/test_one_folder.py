"""Two commands and one folder: one after the other, at the same time, and after one that was killed."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from diffdrive_mpc.bench.report_folder import CONTENTS, staged
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.whole_file import scratch_folder
from processes import is_running


def _write(out: Path, owner: str, *names: str, shared: bool = False) -> None:
    with staged(out, owner=owner, shared=shared) as folder:
        for name in names:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(f"{owner} {name}", encoding="utf-8")


def _there(out: Path) -> set[str]:
    return {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()} - {CONTENTS}


def test_results_of_the_same_command_are_replaced_wholly(tmp_path: Path) -> None:
    """Its old figures go; what somebody else has put there, or has changed, stays."""
    _write(tmp_path, "bench", "bench.md", "figures/a.png", "figures/b.png", "old/c.png")
    (tmp_path / "figures" / "mine.png").write_text("mine", encoding="utf-8")
    (tmp_path / "figures" / "b.png").write_text("retouched by hand", encoding="utf-8")
    _write(tmp_path, "bench", "bench.md", "figures/z.png")
    assert _there(tmp_path) == {"bench.md", "figures/b.png", "figures/mine.png", "figures/z.png"}
    assert not (tmp_path / "old").exists()


def test_two_commands_keep_both_their_results(tmp_path: Path) -> None:
    """The page of the second has a name of its own, then and later; a file of the first is not replaced."""
    _write(tmp_path, "bench", "bench.md", "report.html")
    _write(tmp_path, "tracking", "tracking.md", "report.html")
    _write(tmp_path, "tracking", "tracking.md", "report.html")
    _write(tmp_path, "bench", "bench.md", "report.html")
    assert _there(tmp_path) == {"bench.md", "report.html", "tracking.md", "tracking.html"}
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == "bench report.html"
    assert (tmp_path / "tracking.html").read_text(encoding="utf-8") == "tracking report.html"
    with (
        pytest.raises(ConfigError, match=r"'bench.md' there is a result of `bench`; give another folder"),
        staged(tmp_path, files=("bench.md",), owner="twin"),
    ):
        raise AssertionError("it began")


def test_results_whose_move_fails_leave_the_old_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stale ones included."""
    _write(tmp_path, "bench", "a", "b")
    before = {name: (tmp_path / name).read_bytes() for name in ("a", "b", CONTENTS)}
    move = Path.replace

    def full(self: Path, to: Path) -> Path:
        if self.name == "c":
            raise OSError("disk full")
        return move(self, to)

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="disk full"):
        _write(tmp_path, "bench", "a", "new/b", "c")
    assert _there(tmp_path) == {"a", "b"} and not (tmp_path / "new").exists()
    assert {name: (tmp_path / name).read_bytes() for name in ("a", "b", CONTENTS)} == before


@pytest.mark.parametrize("said", ["", "[]", "{", '{"a": 1}', '{"a": {"by": "bench"}}', '{"../x": null}'])
def test_a_damaged_list_of_contents_is_as_good_as_none(tmp_path: Path, said: str) -> None:
    """Then everything there is somebody else's."""
    (tmp_path / CONTENTS).write_text(said, encoding="utf-8")
    (tmp_path / "a").write_text("mine", encoding="utf-8")
    _write(tmp_path, "bench", "b")
    assert _there(tmp_path) == {"a", "b"}


def test_no_file_outside_is_ever_stale(tmp_path: Path) -> None:
    """A list of contents that names one there, as somebody may write it."""
    out, mine = tmp_path / "out", tmp_path / "mine"
    mine.write_text("mine", encoding="utf-8")
    _write(out, "bench", "a")
    state = mine.stat()
    said = f'{{"../mine": {{"by": "bench", "bytes": {state.st_size}, "changed_ns": {state.st_mtime_ns}}}}}'
    (out / CONTENTS).write_text(said, encoding="utf-8")
    _write(out, "bench", "b")
    assert mine.read_text(encoding="utf-8") == "mine"


def _hold(out: str, ready: object, shared: bool) -> None:
    with staged(Path(out), owner="bench", shared=shared) as folder:
        (folder / "first").write_text("x", encoding="utf-8")
        ready.set()  # type: ignore[attr-defined]
        time.sleep(60)


@pytest.mark.parametrize("shared", [False, True])
def test_a_second_command_is_refused_until_the_first_has_ended_however_it_ends(tmp_path: Path, shared: bool) -> None:
    """A killed one leaves no lock, and what it left unfinished is removed; those who share a folder are let in."""
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    process = context.Process(target=_hold, args=(str(tmp_path), ready, shared))
    process.start()
    try:
        assert ready.wait(60)
        if shared:
            _write(tmp_path, "bench", "second", shared=True)
        else:
            with pytest.raises(ConfigError, match="another command is writing there"):
                _write(tmp_path, "tracking", "second")
    finally:
        process.kill()
        process.join()
    (left,) = tmp_path.glob(".unfinished-*")
    os.utime(left, (0, 0))
    _write(tmp_path, "bench", "third", shared=shared)
    assert "third" in _there(tmp_path)
    assert not list(tmp_path.glob(".unfinished-*"))


def test_a_draft_that_is_being_written_is_not_left_over(tmp_path: Path) -> None:
    """However old it is."""
    with scratch_folder(tmp_path) as first:
        os.utime(first, (0, 0))
        with scratch_folder(tmp_path):
            assert first.is_dir()


def test_workers_end_when_their_parent_is_killed() -> None:
    """They cannot be told; an idle one used to wait for two minutes."""
    program = (
        "import os, time\n"
        "from functools import partial\n"
        "from diffdrive_mpc.bench.runner import lasting_processes, run_tasks\n"
        "with lasting_processes():\n"
        "    print(*set(run_tasks([os.getpid] * 8, 2, lambda: None)), flush=True)\n"
        "    time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        workers = [int(number) for number in process.stdout.readline().split()]
        assert workers
        assert all(map(is_running, workers))
        process.send_signal(signal.SIGKILL)
        process.wait()
    for _ in range(200):
        if not any(map(is_running, workers)):
            return
        time.sleep(0.1)
    raise AssertionError("workers are left")
