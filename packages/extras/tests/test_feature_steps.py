"""Steps of controllers with features import nothing."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from feature_steps import CASES


@pytest.mark.parametrize("name", CASES)
def test_step_with_feature_imports_nothing(name):
    path = os.pathsep.join(filter(None, sys.path))
    words = [sys.executable, str(Path(__file__).with_name("feature_steps.py")), name]
    run = subprocess.run(words, capture_output=True, text=True, check=True, env=os.environ | {"PYTHONPATH": path})
    steps = json.loads(run.stdout)
    assert steps["imported"] == []
    for part in ("rejoining", "no pose was accepted", "a test"):
        assert any(part in message for message in steps["messages"])
