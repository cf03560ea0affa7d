"""One writer of the controller's configuration: values are positive and safe, whatever the identification found."""

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from limit_population import drawn_case, judged

from diffdrive_mpc.models.identification.deliver.configuration import configure
from diffdrive_mpc.models.logs.geometry import WheelGeometry
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.structures.model_file import SmFile
from diffdrive_mpc.models.structures.sm import identify_sm
from diffdrive_mpc.mpc.config.rooms import side_by_side

CHANNEL = {"gain": 0.9, "natural_frequency": 10.0, "damping": 1.2}
WHEELS = {"track": 0.5, "top_speed": 0.4}
COMMANDS = np.repeat([[0.5, -1.0], [-0.3, 0.4]], 30, axis=0)
TRAIN = [Record("drive", 0.0, 0.05, COMMANDS, twist=COMMANDS, yaw_rate=COMMANDS[:, 1])]
GEOMETRY = WheelGeometry(0.1, 0.4)


def identified(slew=None, deviation=0.1, limits=None, effects=None):
    names = ("slew.v", "slew.omega") if slew else ("v.gain",)
    values = np.array(slew or [0.9])
    return IdentifiedModel(
        schema=SmFile,
        content={"channels": {"v": CHANNEL, "omega": CHANNEL}, "base_effects": effects or {}},
        parameters=ParameterEstimate(names, values, np.diag(np.full(len(values), deviation**2))),
        offset=np.zeros(2),
        limits=limits or {},
        yaw="gyro",
        method="made up",
        fits=(),
        warnings=(),
    )


def limits(found, geometry=GEOMETRY):
    return configure("robot", found, TRAIN, geometry).mapping()["limits"]


def test_the_slew_stays_two_deviations_inside_that_of_the_base():
    assert limits(identified(slew=(1.5, 3.0)))["v_slew"] == pytest.approx(1.3)
    assert limits(identified(slew=(1.5, 3.0)))["omega_slew"] == pytest.approx(2.8)
    quick = limits(identified(slew=(9.0, 9.0)))  # no more than the default
    assert (quick["v_slew"], quick["omega_slew"]) == (2.0, 6.0)
    assert "v_slew" not in limits(identified())


@given(st.floats(1e-3, 50.0), st.one_of(st.floats(0.0, 1e6), st.just(np.inf), st.just(np.nan)))
def test_a_slew_hardly_known_is_never_zero_nor_negative(slew, deviation):
    """It failed: two deviations off a slew of 1.0 +- 0.6 m/s^2 were written as -0.2."""
    written = limits(identified(slew=(slew, slew), deviation=deviation))
    for name in ("v_slew", "omega_slew"):
        assert written[name] >= 0.499 * min(slew, 2.0)
        assert written[name] <= 1.001 * slew


def test_limits_are_those_that_the_log_covers_or_the_base_has():
    written = limits(identified(limits={"omega": 0.8}))
    assert (written["v"], written["omega"]) == (0.5, 0.8)
    assert (written["predicted_v"], written["predicted_omega"]) == pytest.approx((0.55, 0.88))


def test_motors_that_saturate_bind_before_what_the_log_asked():
    slow = limits(identified(effects={"wheel_command": WHEELS}))
    assert slow["wheel_speed"] == pytest.approx(0.9 * 0.4)
    fast = limits(identified(effects={"wheel_command": WHEELS | {"top_speed": 5.0}}))
    assert fast["wheel_speed"] == pytest.approx(1.1 * (0.5 + 0.25 * 1.0))


@pytest.mark.parametrize("geometry", [GEOMETRY, None])
@pytest.mark.parametrize("slew", [(1.5, 3.0), None])
def test_the_file_says_what_the_mapping_says(slew, geometry):
    found = configure("robot", identified(slew=slew, effects={"wheel_command": WHEELS}), TRAIN, geometry)
    text = found.text()
    assert side_by_side(yaml.safe_load(text)) == found.mapping()
    assert found.mapping()["sample_time"] == 0.05
    assert ("not in a log" in text) == (slew is None)
    assert ("Not in the log" in text) == (geometry is None)
    if geometry:
        assert found.mapping()["wheels"] == {"track": 0.5, "encoder_track": 0.4}


def test_a_larger_robot_has_more_room_and_a_small_one_no_less_than_usual():
    large = configure("robot", identified(), TRAIN, WheelGeometry(0.2, 0.99)).mapping()
    assert large["reentry"]["band"] == pytest.approx(3 * 0.08)
    assert large["failure"]["max_position_error"] == pytest.approx(3.0)
    small = configure("robot", identified(), TRAIN, WheelGeometry(0.02, 0.1)).mapping()
    assert "reentry" not in small
    fast = [Record("drive", 0.0, 0.05, 6 * COMMANDS, twist=6 * COMMANDS)]
    assert configure("robot", identified(), fast, None).mapping()["reentry"]["wait"] == pytest.approx(
        0.9 * 3 / 1.5 * 0.1
    )


@pytest.mark.parametrize("seed", [2026, 2030])
def test_a_limit_that_is_seldom_reached_is_found(seed):
    case = drawn_case(seed)
    found, close, false = judged(case, identify_sm(case.records).limits)
    assert found and close and not false


@pytest.mark.parametrize(
    ("seed", "odd"), [(2017, "compressed gain"), (2013, "gain of the other channel"), (2040, "slew")]
)
def test_what_is_no_limit_is_not_taken_for_one(seed, odd):
    case = drawn_case(seed)
    assert case.name.endswith(odd)
    assert identify_sm(case.records).limits == {}
