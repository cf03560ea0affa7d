"""What shells are told when they ask how a word goes on."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from diffdrive_mpc.models.load import ROBOT_NAMES, model_names
from diffdrive_mpc.mpc.trajectories.load import BUILT_IN

COMMAND = Path(sys.executable).with_name("diffdrive-mpc")


def completed(words: str, shell: str = "bash") -> list[str]:
    """The words that a shell is offered where `words` stand before the cursor."""
    asked = {
        "_DIFFDRIVE_MPC_COMPLETE": f"complete_{shell}",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split(" ")) - 1),
        "_TYPER_COMPLETE_ARGS": words,
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }
    result = subprocess.run([COMMAND], env=os.environ | asked, capture_output=True, text=True, check=False)
    assert result.stderr == ""
    return result.stdout.splitlines()


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("simulate --trajectory ", set(BUILT_IN)),
        ("simulate --model ", {*model_names(), *ROBOT_NAMES}),
        ("models show s", {"sm", "ssm"}),
        ("bench --models sm,s", {"sm,ssm"}),
        ("simulate --surface grip", {"grippy"}),
        ("simulate --sensors sl", {"slam"}),
        ("simulate --scenario weak", {"weak_motor"}),
        ("simulate --plant mujoco:long", {"mujoco:long", "mujoco:long_naive"}),
        ("simulate --controller lqr", {"lqr", "lqr+slip"}),
        ("simulate --timing st", {"stop"}),
        ("identify drive.csv --mapping simu", {"simulate", "simulated_robot"}),
        ("simulate --set weights.acr", {"weights.across=700.0"}),
        ("simulate --set solver.method", {"solver.method=auto", "solver.method=osqp", "solver.method=daqp"}),
        ("schema tra", {"trajectory"}),
        ("config sh", {"show"}),
        ("tun", {"tune"}),
    ],
)
def test_names_are_completed(words: str, offered: set[str]) -> None:
    assert set(completed(f"diffdrive-mpc {words}")) == offered


def test_other_shells_are_told_what_words_mean() -> None:
    words = "diffdrive-mpc simulate --scenario pus"
    assert "knocked sideways off the path while it drives" in "".join(completed(words, "zsh"))
    assert "knocked sideways off the path while it drives" in "".join(completed(words, "fish"))


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_for_a_shell_is_shown(shell: str) -> None:
    asked = os.environ | {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    shown = subprocess.run([COMMAND, "--show-completion", shell], env=asked, capture_output=True, text=True, check=True)
    assert "_DIFFDRIVE_MPC_COMPLETE" in shown.stdout
