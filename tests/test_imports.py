"""Imports: a command or robot loads only necessary modules, and a step loads no module."""

import subprocess
import sys
from pathlib import Path

import pytest

from steps_without_imports import CASES, check_steps

STEPS = Path(__file__).with_name("steps_without_imports.py")
# Modules of SciPy other than its linear algebra, which discretises models.
SCIPY = {f"scipy.{name}" for name in ("fft", "integrate", "interpolate", "ndimage", "optimize", "signal", "stats")}
REPORTS = {"control", "jinja2", "joblib", "matplotlib", "mcap", "osqp", "pandas", "plotly", "polars", "rosbags"}
SIMULATION = {"diffdrive_mpc.sim", "diffdrive_mpc.bench"}
NUMBERS = {"casadi", "cffi", "daqp", "mujoco", "numpy", "pydantic", "scipy", "yaml"}
MODEL = "from diffdrive_mpc import load_model\nfor name in ('mbm', 'sm', 'ssm'): load_model(name).discretise(0.02)"
CONTROLLER = """
from diffdrive_mpc import Controller, Measurement, load_config, load_trajectory
controller = Controller(load_config("ssm"))
controller.start(load_trajectory("circle"), 0.0)
assert controller.step(0.0, Measurement()).mode.name == "STOPPED"
"""
COMMAND = "import sys; sys.argv[1:] = {}\nfrom diffdrive_mpc.app.cli import main\ntry: main()\nexcept SystemExit: pass"
PLANT = """
from diffdrive_mpc.sim import Run, make_plant, simulate
import diffdrive_mpc.sim.plants.surface
make_plant("model:ssm")
"""
PROGRAMS = {
    "a model": (MODEL, REPORTS | SCIPY | {"mujoco", "rich", "typer"}),
    "a controller": (CONTROLLER, REPORTS | SCIPY | SIMULATION | {"mujoco", "rich", "typer"}),
    "--help": (COMMAND.format(["--help"]), REPORTS | NUMBERS | {"rich"}),
    # A wheel is built with only the packages in `build-system` of pyproject.toml.
    "the schemas": ("import diffdrive_mpc.app.schemas", {"pandas", "rich", "mujoco"}),
    "a plant of a model": (PLANT, {"mujoco"}),
    "simulate": (COMMAND.format(["simulate", "--trajectory", "circle"]), REPORTS | SCIPY),
}


def run(*arguments):
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize("case", PROGRAMS)
def test_only_needed_modules_are_loaded(case):
    code, unwanted = PROGRAMS[case]
    loaded = run("-c", f"{code}\nimport sys; print(*sys.modules)").splitlines()[-1].split()
    assert "diffdrive_mpc" in loaded
    assert not unwanted & set(loaded)


NODE = """
import os, signal
from rclpy.executors import SingleThreadedExecutor
spin_once, spins = SingleThreadedExecutor.spin_once, iter(range(50))
def spin_or_end(self, **options):
    if next(spins, None) is None:
        os.kill(os.getpid(), signal.SIGINT)
    spin_once(self, **options)
SingleThreadedExecutor.spin_once = spin_or_end
"""


def test_active_node_loads_at_most_160_modules_and_none_of_sim_bench_and_log_diagnosis(monkeypatch):
    """Count all modules of the package, including empty modules, with the shipped configuration."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    command = COMMAND.format(["node", "--autostart", "--ros-args", "-p", "discovery_wait:=0.0"])
    # The loop of the executor starts after the activation.
    activated, *loaded = (
        run("-c", f"{NODE}{command}\nprint(next(spins, 'activated'), *sys.modules)").splitlines()[-1].split()
    )
    assert activated == "activated"
    modules = {name for name in loaded if name.partition(".")[0] == "diffdrive_mpc"}
    assert "diffdrive_mpc.mpc.ros.control_loop" in modules
    assert len(modules) <= 160
    folders = ("sim", "bench", "models.logs.diagnosis")
    assert not [name for name in modules if name.removeprefix("diffdrive_mpc.").startswith(folders)]


def test_robot_runs_without_mujoco_and_matplotlib():
    blocked = f"import sys; sys.modules.update(dict.fromkeys({sorted(REPORTS | {'mujoco', 'rclpy', 'rich'})}))\n"
    drive = "from diffdrive_mpc import make_plant, simulate, load_trajectory, Controller, load_config\n"
    drive += "run = simulate(Controller(load_config('ssm')), make_plant('model:ssm'), load_trajectory('circle'))\n"
    assert run("-c", f"{blocked}{drive}print(run.metrics.completed)") == "True\n"


@pytest.mark.parametrize("name", CASES)
def test_step_imports_no_module(name):
    check_steps(STEPS, name)
