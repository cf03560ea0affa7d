"""Whether each kind of doubt matters for driving: one answer for every kind, and no answer for none."""

import ast
from pathlib import Path

import numpy as np
import pytest

from diffdrive_mpc import models
from diffdrive_mpc.models.doubt import VERDICTS, Doubt
from diffdrive_mpc.models.logs import Finding
from diffdrive_mpc.models.logs.record import counted
from diffdrive_mpc.models.output_error.doubts import badly_known
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate

ROOM = Path(models.__file__).parent
TRIALS = ROOM.parent / "bench" / "studies" / "identification"


def kinds_in_the_sources() -> set[str]:
    """Words of every `Doubt(...)`, and of every `Finding(...)` that is more than a note, as the sources write them."""
    found = set()
    for path in (*ROOM.rglob("*.py"), *TRIALS.glob("*.py")):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = getattr(getattr(call, "func", None), "id", "")
            if name not in ("Doubt", "Finding"):
                continue
            if name == "Finding" and getattr(call.args[1], "value", "") == "note":
                continue
            words = [part.value for part in ast.walk(call.args[0]) if isinstance(part, ast.Constant)]
            found |= {word for word in words if isinstance(word, str)}
    return found


def test_every_kind_has_its_verdict():
    kinds = kinds_in_the_sources()
    assert len(kinds) > 30
    assert kinds - set(VERDICTS) == set()


def test_a_verdict_stands_once_behind_what_is_said():
    doubt = Doubt("second lag", "damping = 2 is badly known").of("v")
    assert str(doubt) == "v: damping = 2 is badly known (does not matter for driving: one lag is enough)"
    spikes = [Finding("spikes", "warning", f"{at} s", "spikes") for at in range(4)]
    gap = Finding("gap", "note", "5 s", "a gap")
    lines = counted([*spikes, gap])
    assert [line.count("for driving") for line in lines] == [1, 1, 0]
    assert lines[1].startswith("1 s: spikes (and 2 more like it) (does not matter")


@pytest.mark.parametrize(("correlation", "kind"), [(0.999, "second lag"), (0.0, "lag")])
def test_a_lag_that_is_known_only_as_a_whole_does_not_matter(correlation, kind):
    """Natural frequency and damping that rise together leave 2 damping / natural frequency as it is."""
    values = np.array([1.0, 100.0, 2.0])
    sigma = np.array([0.01, 80.0, 1.6])
    both = np.eye(3)
    both[1, 2] = both[2, 1] = correlation
    estimate = ParameterEstimate(("v.gain", "v.natural_frequency", "v.damping"), values, both * np.outer(sigma, sigma))
    assert [doubt.kind for doubt in badly_known(estimate)] == [kind, kind]
