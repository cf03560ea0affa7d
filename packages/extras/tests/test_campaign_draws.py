"""Draws of a campaign: distributions, runs that do not depend on the number of runs, and invalid files."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from diffdrive_mpc.bench.comparison.other_robots import other_robots
from diffdrive_mpc.bench.controllers import controller_config
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.sim.plants.drawn_robot import draw_robot
from diffdrive_mpc_extras.campaign.campaign_file import load_campaign, spread_points
from diffdrive_mpc_extras.campaign.draws import read_factor
from diffdrive_mpc_extras.campaign.drivable_robots import RESERVED, can_drive, driving_seeds, skidding_time
from refusals import one_line_error

HEAD = "description: of a test\nruns: 16\n"


def write_campaign(folder: Path, factors: str, head: str = HEAD) -> Path:
    path = folder / "campaign.yaml"
    path.write_text(f"{head}factors:\n" + "".join(f"  {line}\n" for line in factors.splitlines()), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        ({"uniform": [2.0, 6.0]}, stats.uniform(2.0, 4.0)),
        ({"log_uniform": [0.1, 10.0]}, stats.loguniform(0.1, 10.0)),
        ({"normal": {"mean": 1.0, "sd": 0.5}}, stats.norm(1.0, 0.5)),
        ({"normal": {"mean": 1.0, "sd": 0.5, "low": 0.8, "high": 2.0}}, stats.truncnorm(-0.4, 2.0, 1.0, 0.5)),
    ],
)
def test_draw_has_the_named_distribution(data: object, expected: stats.rv_continuous) -> None:
    draw = read_factor(data, "x")
    values = [float(draw.value(point, 0)) for point in spread_points("sobol", 1024, 1, 7)[:, 0]]
    # Low-discrepancy points are nearer to their distribution than random points.
    assert stats.kstest(values, expected.cdf).statistic < 0.005


def test_first_runs_do_not_depend_on_the_number_of_runs(tmp_path: Path) -> None:
    path = write_campaign(tmp_path, "model: {one_of: [ssm, sm]}\nsurface.friction: {uniform: [0.3, 1.0]}")
    campaign = load_campaign(path)
    assert campaign.definitions(100)[:10] == campaign.definitions(10)
    assert len(set(campaign.definitions(100))) == 100
    assert [definition.case.seed for definition in campaign.definitions(3)] == [0, 1, 2]


def test_condition_sets_plant_surface_and_settings(tmp_path: Path) -> None:
    (definition,) = load_campaign(write_campaign(tmp_path, "condition: long\nconfig.horizon: 20")).definitions(1)
    assert definition.case.plant == "mujoco:long"
    config = controller_config(definition.case.model, None, definition.case.overrides)
    assert (config.wheels.track, config.horizon) == (0.596, 20)


def test_files_in_the_folder_of_the_campaign_are_found(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("name: mine\nsegments:\n- {v: 0.3, omega: 0.4, duration: 1.0}\n")
    (tmp_path / "floor.yaml").write_text("friction: 0.5\n")
    lines = "trajectory: {one_of: [mine.yaml, circle]}\nplant: mujoco:floor.yaml"
    runs = load_campaign(write_campaign(tmp_path, lines)).definitions()
    assert {run.case.trajectory for run in runs} == {str(tmp_path / "mine.yaml"), "circle"}
    assert runs[0].columns["plant"] == "mujoco:floor"


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("surface.friction: {uniform: [1, 0]}", "factors.surface.friction: give the lower value first (found 1, 0)"),
        ("trajektory: circle", "unknown factor 'trajektory'; did you mean 'trajectory'?"),
        ("condition: long\nplant: mujoco", "factors.plant: also set by the condition; remove one of them"),
        ("controller: pid", "unknown controller 'pid'; known: mpc"),
        (
            "top_speed: {normal: {mean: 0, sd: 1, low: 60, high: 70}}",
            "the normal distribution has no probability between",
        ),
    ],
)
def test_invalid_factor_raises_a_one_line_error(lines: str, message: str, tmp_path: Path) -> None:
    with one_line_error(ConfigError, message):
        load_campaign(write_campaign(tmp_path, lines)).definitions()


def test_skidding_time_equals_the_force_balance_of_coulomb_wheels():
    """Differentiate the longitudinal force of four Coulomb wheels in a steady turn with respect to the wheel speed."""
    base, track, friction, yaw_rate, mass = 0.6, 0.5, 0.7, 0.5, 20.0

    def force(excess: float) -> float:
        total = 0.0
        for side in (-1.0, 1.0):
            skid = np.array([side * yaw_rate * base**2 / track / 2 + excess, yaw_rate * base / 2])
            total += 2 * friction * mass * 9.81 / 4 * skid[0] / np.linalg.norm(skid)
        return total

    slope = (force(1e-6) - force(-1e-6)) / 2e-6
    assert skidding_time(yaw_rate, track, base, friction) == pytest.approx(mass / slope, rel=1e-6)


def test_half_of_the_seeds_are_reserved():
    """Tuning uses odd seeds."""
    assert RESERVED == 2
    for tuning in (False, True):
        seeds = driving_seeds(20, spot_turns=True, tuning=tuning)
        assert {seed % RESERVED for seed in seeds} == {int(tuning)}
        candidates = range(int(tuning), seeds[-1] + 1, RESERVED)
        assert seeds == [seed for seed in candidates if can_drive(draw_robot(seed), spot_turns=True)]


def test_robots_of_the_bench_are_the_first_reserved_robots_that_can_drive():
    robots = other_robots().population.robots
    assert list(robots) == driving_seeds(len(robots), spot_turns=False)
