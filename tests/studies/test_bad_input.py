"""Bad input of a study ends in one line and exit code 2, and nothing is made."""

from __future__ import annotations

from pathlib import Path

import pytest

from commands import invoke
from studies.cli import app

KNOWN = "mbm_sm, ssm, lstm, cost, virtual_track, drive_models"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("monitor --rules defalt", "did you mean 'default'"),
        ("reproduce --only ssm,costs", f"error: --only: unknown part 'costs'; known: {KNOWN}\n"),
        ("robustness --quick --only nowhere", "--only: unknown condition 'nowhere'; known: default, heavy"),
        ("robustness --quick --controllers pid", "--controllers: unknown controller 'pid'; known: mpc"),
        ("robustness --quick --models smm", "unknown model 'smm'"),
        ("speed --horizons 0", "--horizons"),
        ("speed --models nobody", "nobody"),
        ("speed --peers nobody", "nobody"),
        ("tracking --only cros", "unknown part 'cros'"),
        ("tracking --quick --study mine.yaml", "give one of them"),
        ("tracking --study missing.yaml", "missing.yaml: cannot be read"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_made(arguments: str, message: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = invoke(app, *arguments.format(folder=tmp_path).split(), "--out", out, code=2)
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1
    assert message in result.stderr
    assert not out.exists()
