"""Worlds by name: from a YAML file, or drawn by a seed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError, check, read_yaml
from diffdrive_mpc.models.named_file import named_file
from diffdrive_mpc.sim.disturbances.drawn_values import check_drawn, drawn, extremes
from diffdrive_mpc_extras.worlds.world import World

SHIPPED = Path(__file__).parent / "shipped"
PATTERN = "drawn:SEED, drawn:SEED:through"
"""How the names of drawn worlds look."""
# Spawn keys of sensors, encoders and scenarios are 0 to 2, 1000 and 2080: a world changes none of their draws.
_SPAWN_KEY = 3_001


def load_world(name: str | Path, seed: int = 0) -> World:
    """The world of a run.

    Parameters
    ----------
    name
        A shipped world, the path of a file, or `drawn:SEED` or `drawn:SEED:through` (see `drawn_world`).
    seed
        Of the run, not negative: what a file leaves open for its movers is drawn from it.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is no such world, its file has a mistake, or a value out of range could be drawn from it.
    """
    match = re.fullmatch(r"drawn:(\d{1,18})(:through)?", str(name), re.ASCII)
    if match:
        from diffdrive_mpc_extras.worlds.drawn_world import drawn_world  # noqa: PLC0415 - loads SciPy

        return drawn_world(int(match[1]), through=match[2] is not None)
    if str(name).startswith("drawn"):
        raise ConfigError(f"world '{name}': a drawn one is called {PATTERN}, SEED being a number")
    path = named_file("world", SHIPPED, name, others=f", {PATTERN}")
    data = read_yaml(path)
    return _with_movers(data, seed, str(path))


def _with_movers(data: Any, seed: int, where: str) -> World:  # noqa: ANN401 - what stands in a file
    """Ranges are read among the movers only: elsewhere two numbers are a point."""
    movers = data.get("movers") if isinstance(data, Mapping) else None
    if not isinstance(movers, list):
        return check(World, data, where)
    check_drawn(movers, f"{where}: movers")
    for values in extremes(movers):
        check(World, {**data, "movers": values}, where)
    stream = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_SPAWN_KEY,)))
    return check(World, {**data, "movers": drawn(movers, stream)}, where)
