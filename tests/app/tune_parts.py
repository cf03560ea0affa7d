"""Small plans for tests of the tuning."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import yaml

from diffdrive_mpc.app.tune.search import ConfigurationSearch, Searched
from diffdrive_mpc.app.tune.tune_file import TunePlan, load_plan
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc_extras.campaign.engine import CampaignPlace

SHORT = "name: short\nsegments:\n- {v: 0.4, omega: 0.5, duration: 0.6}\n"
PLAN = """
description: short drives of a model
points: 11
at_once: 5
parameters:
  weights.across: {times: [0.2, 5.0]}
  weights.omega_increment: {times: [0.2, 10.0]}
  horizon: {low: 15, high: 40}                      # steps
objective:
  error: {position_rmse_m: {mean: 0.5, cvar: 0.2}}
  effort: {recovery_command_rate_omega: {mean: 0.3}}
fidelities: [{runs: 1}, {runs: 2}]
tuning: {draw_seed: 1, first_seed: 600}
verdict: {runs: 6, put_back: 2, draw_seed: 2, first_seed: 700}
factors: {plant: "model:sm", trajectory: short.yaml}
"""


def written(folder: Path, changes: Mapping[str, object] | None = None) -> Path:
    """The plan as a file beside its path, with other values at the top level."""
    (folder / "short.yaml").write_text(SHORT, encoding="utf-8")
    path = folder / "plan.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(PLAN) | dict(changes or {})), encoding="utf-8")
    return path


def small_plan(folder: Path, **changes: object) -> TunePlan:
    """The same, read."""
    return load_plan(written(folder, changes))


def searched(plan: TunePlan, out: Path, worker: int = 1) -> Searched:
    """What a search finds for the SSM, in this process."""
    with ProgressBar("searching") as bar:
        return ConfigurationSearch(plan, {"model": "ssm"}, CampaignPlace(out, 1), worker=worker).run(bar)
