"""`import diffdrive_mpc`: its names and errors, and its use in a folder with files of any name."""

import importlib
import inspect
import pkgutil
import subprocess
import sys

import pytest

import diffdrive_mpc

# Packages that only the speed benchmark installs, or types without a wheel.
NOT_INSTALLED = {"acados_template", "do_mpc", "nav2_msgs"}


def all_modules():
    for result in pkgutil.walk_packages(diffdrive_mpc.__path__, "diffdrive_mpc."):
        try:
            yield importlib.import_module(result.name)
        except ModuleNotFoundError as error:
            assert error.name in NOT_INSTALLED, result.name


def test_every_error_of_the_project_has_the_common_base():
    errors = {
        cls
        for module in all_modules()
        for _, cls in inspect.getmembers(module, inspect.isclass)
        if issubclass(cls, BaseException) and cls.__module__.startswith("diffdrive_mpc.")
    }
    assert {diffdrive_mpc.ConfigError, diffdrive_mpc.ModelError, diffdrive_mpc.RobotLostError} <= errors
    assert [cls for cls in errors if not issubclass(cls, (diffdrive_mpc.DiffdriveMpcError, Warning))] == []


@pytest.mark.parametrize("name", diffdrive_mpc.__all__)
def test_every_public_name_exists(name):
    assert getattr(diffdrive_mpc, name).__name__ == name
    assert name in dir(diffdrive_mpc)


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


def test_script_runs_next_to_files_named_like_the_folders(tmp_path):
    for folder in ("models", "mpc", "sim", "bench", "app"):
        (tmp_path / f"{folder}.py").write_text("'of the user'\n")
    (tmp_path / "script.py").write_text(SCRIPT)
    result = subprocess.run([sys.executable, "script.py"], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert result.stdout == "TRACKING True\n", result.stderr
