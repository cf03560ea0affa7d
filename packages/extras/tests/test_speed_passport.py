"""`diffdrive-mpc prove --tolerance`: error rates of its statistics, and paths timed by a passport."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.stats import norm

from commands import call
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.trajectories import load_segments
from diffdrive_mpc.mpc.trajectories.random_spline import random_splines
from diffdrive_mpc_extras.campaign.campaign_file import Campaign
from diffdrive_mpc_extras.campaign.engine import CampaignPlace, drive_all
from diffdrive_mpc_extras.campaign.rates import Rate
from diffdrive_mpc_extras.proof.passport import PASSPORT, Key, SpeedSearch, max_lateral, measure, members
from diffdrive_mpc_extras.proof.proof_file import load_proof

SHIPPED = load_proof(None)
ROBOTS = {name: data for name, data in SHIPPED.factors.items() if name not in {"trajectory", "scenario"}}


def test_error_rate_of_accepted_speeds_is_below_the_stated_level() -> None:
    # Log-normal errors with a median of 0.1 s times the speed; many speeds are slightly too fast.
    spread, tolerance = 0.5, 0.05
    limit_speed = tolerance / 0.1 / np.exp(spread * norm.ppf(0.95))
    speeds = [limit_speed * factor for factor in (0.2, 0.4, 0.6, 0.8, 0.95, 1.0 + 1e-9, 1.02, 1.05, 1.1, 1.2, 1.4)]
    plan, repeats, wrong_count, rejected_count = SHIPPED.passport, 80, 0, 0
    for repeat in range(repeats):

        def drive(keys: list[Key], repeat: int = repeat) -> Mapping[Key, FloatArray]:
            lateral = {}
            for key in keys:
                _, _, number, block, first = key
                normal = np.random.default_rng([repeat, block, first]).standard_normal(len(members(plan, block, first)))
                lateral[key] = 0.1 * speeds[number] * np.exp(spread * normal)
            return lateral

        search = SpeedSearch("floor", 0.0, tolerance, speeds, plan)
        measure([search], drive)
        wrong_count += search.speed is not None and search.speed > limit_speed
        rejected_count += search.speed is None
    assert Rate.of_runs(wrong_count, repeats).low < 1.0 - plan.confidence
    assert rejected_count < 0.1 * repeats


PLAN: dict[str, Any] = {
    "share": 0.7,
    "confidence": 0.8,
    "search_runs": 5,
    "proof_runs": 8,
    "tries": 2,
    "draw_seed": 5,
    "curvatures": [0.0, 2.0],
    "speeds": [0.2, 0.5, 1.0],
    "straight": 0.5,
    "arc": 1.0,
    "surfaces": {"firm": SHIPPED.passport.surfaces["firm"]},
}


@pytest.fixture(scope="module")
def passport_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small passport."""
    folder = tmp_path_factory.mktemp("passport")
    proof = {"description": "drawn robots", "runs": 1, "factors": ROBOTS, "passport": PLAN}
    (folder / "mine.yaml").write_text(yaml.safe_dump(proof), encoding="utf-8")
    arguments = ["--campaign", folder / "mine.yaml", "--tolerance", "0.03,0.01", "--out", folder / "out", "--jobs", "1"]
    call("prove", "ssm", *arguments)
    return folder / "out"


def test_passport_consists_of_table_page_and_file(passport_folder: Path) -> None:
    passport = yaml.safe_load((passport_folder / PASSPORT).read_text(encoding="utf-8"))
    assert [(row["surface"], row["tolerance"]) for row in passport["rows"]] == [("firm", 0.01), ("firm", 0.03)]
    rows = json.loads((passport_folder / "passport.json").read_text(encoding="utf-8"))["speeds"]
    assert [row["speed"] for row in rows] == [speed for row in passport["rows"] for speed in row["speeds"]]
    fresh = [rate for row in rows for rate in row["fresh"].values()]
    assert {rate["of"] for rate in fresh} == {PLAN["proof_runs"]}
    # A larger tolerance permits higher speeds.
    assert all(tight <= wide for tight, wide in zip(*(row["speeds"] for row in passport["rows"]), strict=True))
    text = (passport_folder / "passport.md").read_text(encoding="utf-8")
    assert "within 10 mm [m/s]" in text
    assert "one-sided lower bound at 90.0 % is at least 70 %; there are 2 tries" in text
    assert (passport_folder / "report.html").is_file()


def held_out(
    folder: Path,
    passport: Path | None,
    surface: str,
    tolerance: float,
    paths: list[str],
    runs: int,
    jobs: int | None = 1,
) -> Rate:
    """Return the rate of robots that stay within the tolerance on paths with or without a passport.

    Paths, robots and seeds are held out.
    """
    factors = ROBOTS | SHIPPED.passport.surfaces[surface] | {"seed": {"each": 90000}, "trajectory": {"one_of": []}}
    entry = {"speed_passport": {"file": str(passport), "surface": surface, "tolerance": tolerance}} if passport else {}
    files = []
    for name in paths:
        path = folder / f"{name}-{surface}-{tolerance:g}-{passport is not None}.yaml"
        path.write_text(yaml.safe_dump({"timing": "smooth", **make_path(name), **entry}), encoding="utf-8")
        files.append(str(path))
    factors["trajectory"] = {"one_of": files}
    campaign = Campaign(description="held out", runs=runs, sampler="random", draw_seed=90, factors=factors)
    with ProgressBar("") as bar:
        place = CampaignPlace(folder / "runs", jobs)
        outcomes = drive_all(
            [definition.with_factors({"model": "ssm"}) for definition in campaign.definitions()], place, bar
        )
    assert not [run.row["error"] for run in outcomes if run.row["error"]]
    return Rate.of_runs(sum(max_lateral(run) <= tolerance for run in outcomes), runs)


def make_path(name: str) -> dict[str, object]:
    """Build a path as fast as the limits permit: bends, random waypoints, or segments with increased speed."""
    if name.startswith("spline-"):
        return {"waypoints": random_splines().waypoints(int(name.removeprefix("spline-"))).tolist()}
    if name == "bends":
        bends = (0.0, 1.8, -1.4, 0.9)
        return {"segments": [{"v": 0.9, "omega": 0.9 * bend, "duration": 1.0} for bend in bends]}
    segments = load_segments(name)
    faster = min(min(1.5 / abs(segment.v), 2.0 / max(abs(segment.omega), 1e-9)) for segment in segments)
    rows = [
        {"v": faster * segment.v, "omega": faster * segment.omega, "duration": segment.duration / faster}
        for segment in segments
    ]
    return {"segments": rows}


def test_only_paths_timed_by_a_passport_stay_within_the_tolerance(passport_folder: Path, tmp_path: Path) -> None:
    assert held_out(tmp_path, passport_folder / PASSPORT, "firm", 0.01, ["bends"], 10).high >= PLAN["share"]
    assert held_out(tmp_path, None, "firm", 0.01, ["bends"], 10).high < PLAN["share"]


LONG_PATHS = ["slalom", "figure8", "cane", "s", "spline-340001", "spline-340002", "spline-340003"]


@pytest.mark.long
def test_paths_timed_by_the_shipped_plan_stay_within_the_tolerance(tmp_path: Path) -> None:
    out = tmp_path / "out"
    call("prove", "ssm", "--tolerance", "0.01,0.02,0.05", "--out", out)
    for surface in SHIPPED.passport.surfaces:
        for tolerance in (0.01, 0.02, 0.05):
            rate = held_out(tmp_path, out / PASSPORT, surface, tolerance, LONG_PATHS, 150, jobs=None)
            assert rate.high >= SHIPPED.passport.share


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--tolerance", "1cm"], "--tolerance '1cm': give lengths in m with commas between them"),
        (["--tolerance", "0.01,0"], "--tolerance '0.01,0': each must be above zero"),
    ],
)
def test_invalid_argument_raises_error_in_one_line(arguments: list[str], message: str, tmp_path: Path) -> None:
    assert message in " ".join(call("prove", "ssm", *arguments, "--out", tmp_path / "out", code=2).split())
