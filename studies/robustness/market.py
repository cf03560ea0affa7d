"""The condition of robots that are drawn as wide as the market sells them."""

from __future__ import annotations

from collections.abc import Mapping

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.sim.plants.names import DRAWN
from diffdrive_mpc_extras.campaign.conditions import Condition
from diffdrive_mpc_extras.campaign.drivable_robots import driving_seeds

MARKET = "market"
"""Name of the condition of drawn robots: one condition, another robot in each run."""


def market_cases(
    robots: int,
    controller: str,
    model: str,
    trajectory: str,
    spot_turns: bool,
    *,
    tuning: bool = False,
    settings: Mapping[str, bool | int | float | str] | None = None,
) -> list[Case]:
    """Runs of the first `robots` reserved robots of the market that can drive a path; see `driving_seeds`.

    With `tuning` those whose seeds are not reserved. Controllers are told what the robot's user states of it, and
    `settings`, configuration values by dotted key.
    """
    return [
        Condition(plant=f"{DRAWN}:{seed}", settings=dict(settings or {})).case(controller, model, trajectory, seed)
        for seed in driving_seeds(robots, spot_turns=spot_turns, tuning=tuning)
    ]
