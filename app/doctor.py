"""Checks of the installation and of this computer for `diffdrive-mpc doctor`."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import NamedTuple

from packaging.requirements import Requirement
from packaging.version import Version

_REPORTED_PACKAGES = ("numpy", "scipy", "casadi", "osqp", "daqp", "mujoco")
_GOVERNORS = "sys/devices/system/cpu"
_REAL_TIME_PRIORITY = 80
"""Priority of `chrt -f 80`, above the priority 50 of interrupt threads with PREEMPT_RT."""
_PROBE_TIMEOUT = 20.0  # s
_ROS_PROBE = """
import rclpy
from rclpy.utilities import get_rmw_implementation_identifier
rclpy.init()
print(get_rmw_implementation_identifier())
rclpy.shutdown()
"""
_ROS_REMEDY = "only for `node` and `sim-robot`: source the setup file of ROS, or pip install 'diffdrive-mpc[ros]'"
_LIMITS_REMEDY = "on a robot add 'USER - rtprio 98' to /etc/security/limits.d/robot.conf"


class Check(NamedTuple):
    """Result of a check."""

    name: str
    is_ok: bool
    finding: str
    remedy: str = ""
    is_required: bool = False
    """True if the controller cannot run unless the check succeeds."""

    @property
    def line(self) -> str:
        """Line of text with status, name, finding and remedy."""
        status = "OK" if self.is_ok else "MISSING" if self.is_required else "WARN"
        remedy = "" if self.is_ok or not self.remedy else f"; {self.remedy}"
        return f"{status:8}{self.name:14}{self.finding}{remedy}"


def examine() -> Iterator[Check]:
    """Run all checks in order; a check that raises an exception counts as failed."""
    for check in (_python, _dependencies, _controller, _compiler, _mujoco, _ros, _governor, _priority):
        yield _run_check(check)


def _run_check(check: Callable[[], Check]) -> Check:
    try:
        return check()
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        name = check.__name__.strip("_")
        return Check(name, False, reason, "report this error with the output above", is_required=check in _REQUIRED)


def _python() -> Check:
    finding = f"{platform.python_version()} on {platform.system()}, {platform.machine()}"
    return Check("python", sys.version_info >= (3, 11), finding, "install Python 3.11 or newer", is_required=True)


def _dependencies() -> Check:
    """Compare installed versions with the requirements of the package without its extras."""
    requirements = [Requirement(text) for text in requires("diffdrive-mpc") or []]
    required = [entry for entry in requirements if entry.marker is None or entry.marker.evaluate({"extra": ""})]
    problems = [problem for requirement in required if (problem := _problem(requirement))]
    versions = ", ".join(f"{name} {_installed_version(name)}" for name in _REPORTED_PACKAGES)
    remedy = "pip install --upgrade diffdrive-mpc"
    return Check("dependencies", not problems, "; ".join(problems) or versions, remedy, is_required=True)


def _problem(requirement: Requirement) -> str:
    installed = _installed_version(requirement.name)
    if installed is None:
        return f"{requirement.name} is not installed"
    fits = requirement.specifier.contains(Version(installed), prereleases=True)
    return "" if fits else f"{requirement.name} {installed} is not {requirement.specifier}"


def _installed_version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def _controller() -> Check:
    """Run two steps of a controller, which loads or compiles the core."""
    from diffdrive_mpc.models.interface import Measurement, Stamped  # noqa: PLC0415 - a broken import is a finding
    from diffdrive_mpc.mpc import Controller, load_config, load_trajectory  # noqa: PLC0415
    from diffdrive_mpc.mpc.core.packaged import packaged_libraries  # noqa: PLC0415

    controller = Controller(load_config("ssm"))
    controller.start(load_trajectory("circle"), 0.0)
    controller.step(0.0, Measurement(pose=Stamped((0.0, 0.0, 0.0), 0.0), yaw_rate=Stamped(0.0, 0.0)))
    step = controller.step(controller.config.sample_time, Measurement())
    library = next(packaged_libraries(), None)
    core = f"core compiled for {platform.machine()}" if library is None else f"core {library.stem} of the wheel"
    time = f"{1e3 * step.step_time:.2f} ms per step, at most {controller.operations_bound:,} operations"
    return Check("controller", step.mode == "TRACKING", f"{step.mode}, {core}, {time}", is_required=True)


def _compiler() -> Check:
    from diffdrive_mpc.models.compiled.compiler import NotCompiledError, find_compiler  # noqa: PLC0415

    try:
        path, words = find_compiler()
    except NotCompiledError:
        return Check("compiler", False, "no C compiler", "custom costs and models need a compiler: apt install gcc")
    return Check("compiler", True, f"{Path(path).name}: {words.splitlines()[0]}")


def _mujoco() -> Check:
    from diffdrive_mpc.sim import make_plant  # noqa: PLC0415

    plant = make_plant("mujoco", "default", "default", 0)
    plant.advance((0.1, 0.0))
    return Check("mujoco", True, f"MuJoCo {_installed_version('mujoco')} simulated {1e3 * plant.time:.1f} ms")


def _ros() -> Check:
    """Import rclpy in a separate process, because faulty middleware can crash the process."""
    sourced = os.environ.get("ROS_DISTRO", "")
    probe = subprocess.run(
        [sys.executable, "-c", _ROS_PROBE], capture_output=True, text=True, timeout=_PROBE_TIMEOUT, check=False
    )
    if probe.returncode == 0:
        return Check("ROS 2", True, f"rclpy with {probe.stdout.split()[-1]}" + (f", {sourced}" if sourced else ""))
    reason = (probe.stderr.strip() or f"exit code {probe.returncode}").splitlines()[-1]
    if sourced:
        remedy = "use the Python of ROS: python3 -m venv --system-site-packages"
        return Check("ROS 2", False, f"{sourced} is sourced, but rclpy does not start ({reason})", remedy)
    return Check("ROS 2", False, f"rclpy does not start ({reason})", _ROS_REMEDY)


def _governor(root: Path = Path("/")) -> Check:
    """Read the CPU frequency governors; virtual machines usually have no governors."""
    files = sorted((root / _GOVERNORS).glob("cpu[0-9]*/cpufreq/scaling_governor"))
    governors = sorted({file.read_text(encoding="utf-8").strip() for file in files})
    remedy = "the duration of steps varies: sudo cpupower frequency-set -g performance"
    finding = ", ".join(governors) or "no CPU governor is visible"
    return Check("CPU governor", governors in ([], ["performance"]), finding, remedy)


def _priority() -> Check:
    """Check that this user may run the node with `chrt -f 80`."""
    if shutil.which("chrt") is None or sys.platform == "win32":
        return Check("real time", True, "no chrt on this system")
    import resource  # noqa: PLC0415 - not on every system

    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    allowed = os.geteuid() == 0 or limit == resource.RLIM_INFINITY or limit >= _REAL_TIME_PRIORITY
    finding = f"chrt -f {_REAL_TIME_PRIORITY} is {'allowed' if allowed else 'refused'}"
    return Check("real time", allowed, finding, _LIMITS_REMEDY)


_REQUIRED = (_python, _dependencies, _controller)
