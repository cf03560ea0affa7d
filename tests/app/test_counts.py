"""How many runs a command is asked for: said before they are listed."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest

from diffdrive_mpc.bench.case import combinations
from diffdrive_mpc.bench.comparison.plan import plan_cases, read_options
from diffdrive_mpc.bench.sweep import sweep_settings
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs.reading import read_log


def test_a_grid_is_counted_before_it_is_listed() -> None:
    """10^12 combinations of four settings, and of four dimensions."""
    tracemalloc.start()
    values = ",".join(map(str, range(1, 1001)))
    with pytest.raises(ValueError, match="1,000,000,000,000 runs are asked for, at most 100,000"):
        sweep_settings([f"weights.{name}={values}" for name in ("along", "across", "heading", "v")])
    names = [str(i) for i in range(1000)]
    with pytest.raises(ValueError, match="1,000,000,000,000 runs"):
        combinations(model=names, trajectory=names, surface=names, seed=range(1000))
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()
    assert len(combinations(seed=range(5), model=["a", "b"])) == 10


def test_a_bench_counts_its_controllers_and_settings_too() -> None:
    """Places alone would be few enough."""
    asked = read_options({"seeds": "10000", "trajectories": "circle,s"}, settings=["weights.across=1,2,3,4,5,6"])
    with pytest.raises(ValueError, match="480,000 runs"):
        plan_cases(asked)


def test_a_log_that_pauses_for_years_is_not_filled_with_samples(tmp_path: Path) -> None:
    """A mapping that allows any gap: 5,000,000,300 samples, 37 GiB for the first array."""
    log, mapping = tmp_path / "years.csv", tmp_path / "any.yaml"
    rows = [(0.02 * i, (-1) ** (i // 50) * 0.3) for i in range(300)]
    rows += [(1e8 + t, v) for t, v in rows]
    log.write_text("t,v,w,m\n" + "".join(f"{t:.2f},{v},{-v},{0.9 * v}\n" for t, v in rows), encoding="utf-8")
    columns = "time: t, command: {v: v, omega: w}, encoders: {v: m, omega: w}"
    mapping.write_text(f"gap: 1.0e+9\ncolumns: {{{columns}}}\n", encoding="utf-8")
    tracemalloc.start()
    with pytest.raises(ConfigError, match="more than 2,000,000 samples; give a shorter 'gap'"):
        read_log(log, mapping)
    assert tracemalloc.get_traced_memory()[1] < 100e6  # a block of text is 16 MB
    tracemalloc.stop()
    mapping.write_text(f"columns: {{{columns}}}\n", encoding="utf-8")
    assert len(read_log(log, mapping).records) == 2
