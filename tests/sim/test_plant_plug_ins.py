"""Plants and simulator parts that packages register."""

from typing import Any

import pytest

from diffdrive_mpc import MissingPackageError, make_plant
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.models import plug_ins


@pytest.fixture
def no_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Environment without installed packages."""
    monkeypatch.setattr(plug_ins, "_entries", lambda group: {})
    plug_ins.plug_in.cache_clear()
    yield
    plug_ins.plug_in.cache_clear()


@pytest.mark.usefixtures("no_packages")
@pytest.mark.parametrize(
    ("make", "part"),
    [
        (lambda: make_plant("world:slalom"), "plant 'world'"),
        (lambda: make_plant("mujoco", sensors="power"), "plant 'power'"),
        (lambda: Case(plant="world:slalom@mujoco:heavy"), "plant 'world'"),
    ],
)
def test_missing_package_of_a_plant_or_part_is_named_in_one_line(make: Any, part: str) -> None:
    with pytest.raises(MissingPackageError, match=rf"^{part} is in the package diffdrive-mpc-extras: pip install .*$"):
        make()
