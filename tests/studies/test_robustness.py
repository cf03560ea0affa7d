"""Robustness study: conditions that can be run, and sensor faults that must not be reported."""

import numpy as np
import pytest

from diffdrive_mpc import make_plant
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import controller_config, run_case
from diffdrive_mpc_extras.campaign.campaign_file import load_conditions
from studies.robustness.results import condition_columns, market_cases

pytestmark = pytest.mark.system

CONDITIONS = load_conditions()


@pytest.mark.parametrize("name", CONDITIONS.conditions)
def test_every_condition_has_an_existing_plant_and_settings(name: str) -> None:
    case = CONDITIONS.conditions[name].case("mpc", "ssm", "circle", 1)
    config = controller_config(case.model, case.config, case.overrides)
    plant = make_plant(case.plant, case.surface, case.sensors, case.seed, scenario=case.scenario)
    assert plant.sample_time == config.sample_time
    plant.reset([0.0, 0.0, 0.0])
    plant.measure()
    plant.advance([0.1, 0.0])
    assert plant.time == plant.sample_time


@pytest.mark.long
def test_no_sensor_of_fault_free_robots_of_the_market_is_disabled() -> None:
    """Slopes, displaced loads, patches, wrong tracks and poor poses are not sensor faults."""
    cases = [case for path in ("circle", "s") for case in market_cases(6, "mpc", "ssm", path, spot_turns=False)]
    disabled = [case.plant for case in cases if any(" not used: " in message for message in run_case(case).messages)]
    assert disabled == []


@pytest.mark.parametrize("seed", [712, 1009, 2289, 4536])
def test_change_of_turning_direction_is_not_reported_as_a_sensor_fault(seed: int) -> None:
    """In an S, the slip changes its side: the two turns cancel, but their displacement and slip do not."""
    run = run_case(Case(trajectory="s", plant=f"drawn:{seed}", seed=seed))
    assert run.metrics.completed
    assert not [message for message in run.messages if " not used: " in message]


@pytest.mark.parametrize("trajectory", ["circle", "s", "k_turn"])
def test_late_poses_from_the_start_are_not_reported_as_a_sensor_fault(trajectory: str) -> None:
    """The robot is at rest before the first reading, so that the delay is observable from the first turn on."""
    run = run_case(Case(trajectory=trajectory, sensors="poses_200ms_arrival"))
    assert run.metrics.completed
    assert not [message for message in run.messages if " not used: " in message]


@pytest.mark.parametrize("name", ["default", "biased_gyro"])
def test_heading_variance_of_the_estimate_is_consistent(name: str) -> None:
    condition = CONDITIONS.conditions[name]
    paths = ("circle", "square", "s", "cane")
    cases = [condition.case("mpc", "ssm", path, 50) for path in paths]
    result = [condition_columns(CONDITIONS.settled, case, run_case(case))["heading_nees"] for case in cases]
    assert 0.3 < sum(result) / len(result) <= 2.0  # type: ignore[arg-type]


def test_error_is_small_with_poses_ten_times_noisier_than_stated() -> None:
    errors = []
    for seed in (50, 52, 54):
        case = CONDITIONS.conditions["noise_5cm"].case("mpc", "sm", "circle", seed)
        run = run_case(case)
        assert run.metrics.completed
        lateral = condition_columns(2.0, case, run)["late_lateral_m"]
        assert isinstance(lateral, float)
        assert lateral < 0.05
        errors.append(run.metrics.position_rmse_m)
    # Twice the error once the scatter is known; 0.03 m if it is learned too late.
    assert np.mean(errors) < 0.03
