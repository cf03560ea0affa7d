"""`doctor` on computers that are made up: it says what is there, and never falls over."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.testing import CliRunner

from commands import invoke
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.app.doctor import computer, examination, pictures, product, real_time, ros
from diffdrive_mpc.app.doctor.machine import Machine, MachineFinding
from diffdrive_mpc.models.compiled.cache import CACHE_VARIABLE


@dataclass(frozen=True)
class MadeUp(Machine):
    """A computer of a few files, whose loops wake `late` [s] after they should."""

    late: float = 1e-4
    limits: int | None = 0
    user: int | None = 1000
    packages: tuple[tuple[str, str], ...] = ()
    needs: tuple[str, ...] = ()
    libraries: tuple[str, ...] = ()
    room: int | None = 10**10
    clock: bool | None = True

    def lateness(self, period: float, duration: float) -> list[float]:
        return [self.late] * round(duration / period)

    def limit(self, name: str) -> int | None:
        return self.limits

    def user_id(self) -> int | None:
        return self.user

    def installed(self, distribution: str) -> str | None:
        return dict(self.packages).get(distribution)

    def requirements(self) -> list[str]:
        return list(self.needs)

    def library(self, name: str) -> str | None:
        return f"lib{name}.so.1" if name in self.libraries else None

    def free(self, folder: str) -> int | None:
        return self.room

    def clock_synchronised(self) -> bool | None:
        return self.clock


@pytest.fixture
def made(tmp_path: Path):
    def with_files(
        files: dict[str, str] | None = None, environ: dict[str, str] | None = None, **more: object
    ) -> MadeUp:
        for name, text in (files or {}).items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
            path.chmod(0o755)
        return MadeUp(tmp_path, environ or {}, **more)

    return with_files


def governors(*names: str) -> dict[str, str]:
    return {f"sys/devices/system/cpu/cpu{k}/cpufreq/scaling_governor": f"{name}\n" for k, name in enumerate(names)}


@pytest.mark.parametrize(
    ("names", "status"),
    [(("performance", "performance"), "ok"), (("performance", "powersave"), "warn"), ((), "unknown")],
)
def test_governor(made, names: tuple[str, ...], status: str) -> None:
    found = computer.governor(made(governors(*names)))
    assert found.status == status
    assert all(name in found.found for name in names)


def test_processor_and_its_share_in_a_container(made) -> None:
    info = {"proc/cpuinfo": "model name\t: Made Up 3000\ncpu MHz\t\t: 1800.123\n"}
    assert "Made Up 3000" in computer.processor(made(info)).found
    assert "1800 MHz" in computer.processor(made(info)).found
    limited = computer.processor(made(info | {"sys/fs/cgroup/cpu.max": "50000 100000\n"}))
    assert (limited.status, "0.5" in limited.found) == ("warn", True)
    assert computer.processor(made({"sys/fs/cgroup/cpu.max": "max 100000\n"})).status == "ok"


def test_memory_counts_the_limit_of_a_container(made) -> None:
    info = {"proc/meminfo": "MemTotal:       16000000 kB\nMemAvailable:   12000000 kB\n"}
    assert computer.memory(made(info)).status == "ok"
    limited = computer.memory(made(info | {"sys/fs/cgroup/memory.max": "500000000\n"}))
    assert (limited.status, "limit 500 MB" in limited.found) == ("warn", True)


@pytest.mark.parametrize(
    ("files", "status", "said"),
    [
        ({"proc/cpuinfo": "flags : fpu hypervisor\n"}, "warn", "a virtual machine"),
        ({".dockerenv": ""}, "ok", "a container"),
        ({"proc/sys/kernel/osrelease": "5.15.0-microsoft-standard-WSL2\n"}, "warn", "WSL"),
        ({"proc/cpuinfo": "flags : fpu\n"}, "ok", "none"),
    ],
)
def test_virtualisation(made, files: dict[str, str], status: str, said: str) -> None:
    found = computer.virtualisation(made(files))
    assert (found.status, said in found.found) == (status, True)


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"sys/kernel/realtime": "1\n", "proc/version": "Linux 6.6\n"}, "PREEMPT_RT"),
        ({"proc/version": "Linux 6.1 #1 SMP PREEMPT_DYNAMIC\n"}, "PREEMPT_DYNAMIC"),
        ({"proc/version": "Linux 5.4 #1 SMP\n"}, "without PREEMPT"),
    ],
)
def test_kernel(made, files: dict[str, str], said: str) -> None:
    assert real_time.kernel(made(files)).found == said


@pytest.mark.parametrize(("late", "status"), [(1e-4, "ok"), (5e-3, "warn")])
def test_a_loop_that_wakes_late_is_told(made, late: float, status: str) -> None:
    found = real_time.sleep_jitter(made(late=late))
    assert (found.status, f"{late * 1e3:.2f} ms" in found.found) == (status, True)


@pytest.mark.parametrize(
    ("limits", "user", "status"),
    [(0, 1000, "warn"), (98, 1000, "ok"), (-1, 1000, "ok"), (0, 0, "ok"), (None, 1, "unknown")],
)
def test_real_time_permission(made, limits: int | None, user: int, status: str) -> None:
    assert real_time.real_time_permission(made(limits=limits, user=user)).status == status


@pytest.mark.parametrize(("clock", "status"), [(True, "ok"), (False, "warn"), (None, "unknown")])
def test_clock(made, clock: bool | None, status: str) -> None:
    assert real_time.clock(made(clock=clock)).status == status


def test_slow_clock_source(made) -> None:
    source = "sys/devices/system/clocksource/clocksource0/current_clocksource"
    assert real_time.timer(made({source: "hpet\n"})).status == "warn"
    assert real_time.timer(made({source: "tsc\n"})).status == "ok"


def test_pictures(made) -> None:
    bare = made()
    assert [look(bare).status for look in (pictures.display, pictures.off_screen, pictures.ffmpeg)] == ["missing"] * 3
    whole = made({"bin/ffmpeg": ""}, {"PATH": str(bare.root / "bin"), "DISPLAY": ":0"}, libraries=("EGL",))
    assert [look(whole).status for look in (pictures.display, pictures.off_screen, pictures.ffmpeg)] == ["ok"] * 3
    wrong = pictures.off_screen(made(environ={"MUJOCO_GL": "osmesa"}, libraries=("EGL",)))
    assert (wrong.status, "MUJOCO_GL=egl" in wrong.means) == ("warn", True)


@pytest.mark.parametrize(
    ("environ", "packages", "status"),
    [
        ({}, (), "missing"),
        ({}, (("ros-jazzy-rclpy", "7.1.6"),), "ok"),
        ({"ROS_DISTRO": "jazzy"}, (("ros-jazzy-rclpy", "7.1.6"),), "warn"),
    ],
)
def test_which_ros(made, environ: dict[str, str], packages: tuple[tuple[str, str], ...], status: str) -> None:
    assert ros.ros(made(environ=environ, packages=packages)).status == status


@pytest.mark.parametrize(
    ("number", "status", "said"), [("", "ok", "7400"), ("7", "ok", "9150"), ("102", "warn", "102"), ("x", "warn", "x")]
)
def test_domain(made, number: str, status: str, said: str) -> None:
    found = ros.domain(made(environ={"ROS_DOMAIN_ID": number}))
    assert (found.status, said in found.found) == (status, True)


@pytest.mark.parametrize(("room", "status"), [(64 * 10**6, "warn"), (10**9, "ok"), (None, "unknown")])
def test_shared_memory(made, room: int | None, status: str) -> None:
    assert ros.shared_memory(made(room=room)).status == status


def test_dependencies_and_extras_are_held_against_their_ranges(made) -> None:
    needs = ("numpy>=1.26", "daqp<0.12,>=0.11", 'jax>=0.4; extra == "learn"', 'optuna>=5.0; extra == "tune"')
    there = made(needs=needs, packages=(("numpy", "2.1"), ("daqp", "0.12.1"), ("jax", "0.5")))
    found = product.dependencies(there)
    assert (found.status, found.found) == ("warn", "daqp 0.12.1 is not <0.12,>=0.11")
    extras = {one.what: one for one in product.extras(there)}
    assert {name: one.status for name, one in extras.items()} == {"extra learn": "ok", "extra tune": "missing"}
    assert "diffdrive-mpc[tune]" in extras["extra tune"].means


def test_the_cache_folder_is_tried(made, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    assert product.cache_folder(made()).status == "ok"
    assert not (tmp_path / "cache").exists()
    assert product.cache_folder(made(room=1000)).status == "warn"


def test_a_computer_without_anything_is_described_too(made) -> None:
    """No files, no variables, no programs: as on another system."""
    found = examination.examine(made(limits=None, user=None, room=None, clock=None))
    every = [one for group in found.values() for one in group]
    assert {one.status for one in every} <= {"ok", "warn", "missing", "unknown"}
    assert all(one.found and "Error" not in one.found for one in every)
    assert examination.can_run(found)


def test_a_look_that_fails_is_a_finding(made, monkeypatch) -> None:
    def broken(machine: Machine) -> MachineFinding:
        raise RuntimeError("nobody thought\nof this")

    monkeypatch.setattr(examination, "LOOKS", {"computer": (broken, computer.governor)})
    first, second = examination.examine(made())["computer"]
    assert (first.what, first.status, first.found) == ("broken", "unknown", "RuntimeError: nobody thought of this")
    assert second.what == "CPU governor"


def test_it_fails_only_where_the_controller_cannot_run(monkeypatch) -> None:
    shown = CliRunner().invoke(app, ["doctor", "--json"])
    said = json.loads(shown.stdout)
    assert (shown.exit_code, said["can_run"]) == (0, True)
    assert said["findings"]["controller"][0]["found"].startswith("TRACKING")

    def broken(machine: Machine) -> MachineFinding:
        return MachineFinding("controller", "missing", "does not run", "see below", needed=True)

    monkeypatch.setattr(examination, "LOOKS", {"controller": (broken,)})
    failed = invoke(app, "doctor", code=1)
    assert "missing" in failed.stdout
