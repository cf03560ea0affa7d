"""`import diffdrive_mpc`: what it gives, what it does not load, and that it stands beside files of any name."""

import importlib
import inspect
import pkgutil
import subprocess
import sys

import pytest

import diffdrive_mpc

# They need packages that the speed benchmark installs for itself, or types that have no wheel.
FOREIGN = {"acados_template", "do_mpc", "nav2_msgs"}


def all_modules():
    for found in pkgutil.walk_packages(diffdrive_mpc.__path__, "diffdrive_mpc."):
        try:
            yield importlib.import_module(found.name)
        except ModuleNotFoundError as error:
            assert error.name in FOREIGN, found.name


def test_every_error_of_the_project_has_the_common_base():
    errors = {
        kind
        for module in all_modules()
        for _, kind in inspect.getmembers(module, inspect.isclass)
        if issubclass(kind, BaseException) and kind.__module__.startswith("diffdrive_mpc.")
    }
    assert {diffdrive_mpc.ConfigError, diffdrive_mpc.ModelError, diffdrive_mpc.RobotLostError} <= errors
    assert [kind for kind in errors if not issubclass(kind, (diffdrive_mpc.DiffdriveMpcError, Warning))] == []


@pytest.mark.parametrize("name", diffdrive_mpc.__all__)
def test_every_public_name_is_there(name):
    assert getattr(diffdrive_mpc, name).__name__ == name
    assert name in dir(diffdrive_mpc)


def python(folder, *arguments):
    command = [sys.executable, *arguments]
    result = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_the_import_loads_neither_the_simulation_nor_the_bench_nor_their_packages(tmp_path):
    unwanted = ("diffdrive_mpc.sim", "diffdrive_mpc.bench", "mujoco", "matplotlib")
    code = (
        "import sys, diffdrive_mpc\n"
        f"print([name for name in {unwanted} if name in sys.modules])\n"
        "diffdrive_mpc.Controller, diffdrive_mpc.load_config, diffdrive_mpc.ConfigError\n"
        f"print([name for name in {unwanted} if name in sys.modules])\n"
    )
    assert python(tmp_path, "-c", code).splitlines() == ["[]", "[]"]


SCRIPT = """
import models, mpc, sim, bench
assert not any(hasattr(module, "__path__") for module in (models, mpc, sim, bench))

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant, simulate

config = load_config("ssm", {"horizon": 10})
reference = load_trajectory("circle")
plant = make_plant("model:ssm", sensors="perfect")
plant.reset(reference.sample([0.0]).pose[0])
controller = Controller(config)
controller.start(reference, plant.time)
for _ in range(20):
    step = controller.step(plant.time, plant.measure())
    plant.advance(step.command)
print(step.mode, step.command[0] > 0.1)
"""


def test_a_script_runs_beside_files_that_are_called_as_the_rooms_are(tmp_path):
    for room in ("models", "mpc", "sim", "bench", "app"):
        (tmp_path / f"{room}.py").write_text("'of the user'\n")
    (tmp_path / "script.py").write_text(SCRIPT)
    assert python(tmp_path, "script.py") == "TRACKING True"
