"""Steps of controllers with features import nothing."""

from pathlib import Path

import pytest
from feature_steps import CASES

from steps_without_imports import check_steps


@pytest.mark.parametrize("name", CASES)
def test_step_with_feature_imports_nothing(name):
    check_steps(Path(__file__).with_name("feature_steps.py"), name)
