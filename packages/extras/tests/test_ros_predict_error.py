"""Service `~/predict_error` and the error limit of `follow_path`, over DDS."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from follow_parts import ABORTED, SUCCEEDED, following
from ros_parts import DT, stack
from std_srvs.srv import Trigger

from diffdrive_mpc import Controller
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc.config.config_file import load_config
from diffdrive_mpc.mpc.ros.follow_goal import path_limits, plan_for_robot
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from diffdrive_mpc_extras.predicted_error import predict_error
from diffdrive_mpc_extras.predicted_error.calibration import ErrorScale, load_calibration
from diffdrive_mpc_extras.ros.path_error import ErrorLimit, ErrorPredictor, PredictedErrorSettings
from refusals import one_line_error

PART = {"parts.predicted_error.enabled": True}


def test_service_returns_the_prediction_of_the_controller():
    with stack(trajectory="s", **PART) as s:
        response = s.trigger("predict_error")
        assert response.success, response.message
        predicted = json.loads(response.message)
        expected = predict_error(Controller("ssm"), "s")
        widest = expected.widest("lateral")
        assert (predicted["reference"], predicted["population"], predicted["warnings"]) == ("s", "drawn", [])
        assert predicted["lateral"]["words"] == widest.sentence
        assert predicted["lateral"]["everywhere"] == pytest.approx(expected.lateral.everywhere.max(), abs=1e-5)
        assert predicted["along"]["arc_length"] <= expected.arc_length[-1]


def test_ticks_do_not_wait_for_the_prediction_and_cleanup_ends_the_request(monkeypatch):
    service, jobs = "/diffdrive_mpc/predict_error", []
    with stack(drive=True, **PART) as s:
        s.base.run(20)
        monkeypatch.setattr(s.node._worker, "submit", lambda *job: jobs.append(job))
        client = s.base.node.create_client(Trigger, service)
        s.base.until(lambda: client.service_is_ready() and s.node.count_clients(service), "the service")
        future = client.call_async(Trigger.Request())
        s.base.until(lambda: jobs, "the request")
        commands = s.base.run(10)
        assert not future.done() and commands[-1, 0] > 0.1
        jobs.pop()[3]("result of the side process")
        s.base.until(future.done, "the response")
        assert (future.result().success, future.result().message) == (True, "result of the side process")
        future = client.call_async(Trigger.Request())
        s.base.until(lambda: jobs, "the request")
        s.node.trigger_deactivate()
        s.node.trigger_cleanup()
        s.base.until(future.done, "the response")
        assert (future.result().success, future.result().message) == (False, "the node was deactivated and cleaned up")


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"autostart": False}, "the node is unconfigured; activate it first"),
        ({"config": "kinematic"}, "provenance.origin is assumed"),
    ],
)
def test_failed_prediction_has_a_reason(parameters, reason):
    with stack(**PART, **parameters) as s:
        response = s.trigger("predict_error")
        assert not response.success and reason in response.message


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        (
            {"config": "kinematic", "parts.predicted_error.follow_error_limit": 0.05},
            "follow_error_limit is set, and model 'kinematic': its",
        ),
        ({"parts.predicted_error.error_population": "mine"}, "unknown population 'mine': give drawn"),
    ],
)
def test_unusable_predictor_is_refused_at_configuration_of_the_node(parameters, message):
    with pytest.raises(ValueError, match=message), stack(**parameters):
        pass


X = np.linspace(0.0, 1.0, 21)
CONFIG, SETTINGS = load_config("ssm"), NodeSettings()
CURVED_PATH = np.column_stack([2 * X, 0.3 * np.sin(6 * X), np.arctan(0.9 * np.cos(6 * X))])


def lay_with_limit(limit, response="slow", v=0.0):
    """Plan a curved path with an error limit [m]; with the fixed coefficients its error at full speed is 63 mm."""
    scale = ErrorScale(coefficients={"floor": 0.01, "turning": 0.07}, at_each_place=1.0, everywhere=1.0)
    shipped = load_calibration()
    population = shipped.populations["drawn"].model_copy(update={"lateral": scale})
    calibration = shipped.model_copy(update={"populations": {"drawn": population}})
    settings = PredictedErrorSettings(follow_error_limit=limit, follow_error_response=response)
    predictor = replace(ErrorPredictor.build(Controller("ssm"), settings), calibration=calibration)
    limits = path_limits(CONFIG, np.eye(2), SETTINGS)
    check = ErrorLimit(predictor, settings)
    return plan_for_robot(CURVED_PATH, CURVED_PATH[0], (v, 0.0), limits, SETTINGS, CONFIG, [check]), predictor


def speed_fraction(path):
    """Return the fraction of the full speed from the note of a path."""
    match = re.match(r"driven at (\d+) % of its speed for follow_error_limit$", path.note)
    return 1.0 if match is None else 0.01 * int(match[1])


def test_path_is_slowed_until_its_predicted_error_is_within_the_limit():
    path, predictor = lay_with_limit(1.0)
    assert path.note == ""
    width = predictor.predict(path.reference, CONFIG).lateral.everywhere.max()
    slowed_path, _ = lay_with_limit(0.7 * width)
    assert speed_fraction(slowed_path) in (0.4, 0.6) and slowed_path.reference.duration > 1.5 * path.reference.duration
    assert predictor.predict(slowed_path.reference, CONFIG).lateral.everywhere.max() <= 0.7 * width


def test_path_is_not_slowed_below_the_speed_of_the_robot():
    """A reference that starts below the speed of the robot would fall behind it."""
    path, predictor = lay_with_limit(1.0)
    width = predictor.predict(path.reference, CONFIG).lateral.everywhere.max()
    limit = path_limits(CONFIG, np.eye(2), SETTINGS).v
    slowed_path, _ = lay_with_limit(0.7 * width, v=0.39 * limit)
    assert speed_fraction(slowed_path) >= 0.4
    assert slowed_path.reference.sample([0.0]).twist[0, 0] == pytest.approx(0.39 * limit, rel=0.02)
    with pytest.raises(ConfigError, match="follow_error_limit"):
        lay_with_limit(0.7 * width, v=0.9 * limit)


@pytest.mark.parametrize(
    ("limit", "response", "message"),
    [
        (0.04, "refuse", r"^path: its predicted error is [\d.]+ mm, follow_error_limit is 40.0 mm \(lateral: worst"),
        (0.005, "slow", r"mm, follow_error_limit is 5.0 mm .*; at 20 % of this speed: its predicted error is 21.1 mm"),
    ],
)
def test_path_above_the_limit_at_every_allowed_speed_is_refused(limit, response, message):
    with one_line_error(ConfigError, match=message):
        lay_with_limit(limit, response)


LONG_X = np.linspace(0.0, 2.0, 41)
LONG_PATH = np.column_stack([LONG_X, 0.3 * np.sin(3 * LONG_X), np.arctan(0.9 * np.cos(3 * LONG_X))])


@pytest.mark.usefixtures("ros_types")
@pytest.mark.parametrize("response", ["refuse", "slow"])
def test_path_above_the_error_limit_is_refused_or_driven_slower(response):
    """The limit is three quarters of the predicted error of the path at full speed."""
    controller, settings = Controller("ssm"), NodeSettings()
    limits = path_limits(controller.config, controller.model.dc_gain, settings)
    path = plan_for_robot(LONG_PATH, LONG_PATH[0], (0.0, 0.0), limits, settings, controller.config)
    limit = 0.75 * float(predict_error(controller, path.reference).lateral.everywhere.max())
    settings = {"follow_error_limit": limit, "follow_error_response": response}
    with following(**{f"parts.predicted_error.{key}": value for key, value in settings.items()}) as follow:
        follow.client.send("a", LONG_PATH)
        result = follow.wait_for_end("a", pace=0.2 * DT)
        if response == "refuse":
            assert (result["status"], result["code"]) == (ABORTED, 103)
            assert f"follow_error_limit is {1e3 * limit:.1f} mm (lateral: worst after" in result["words"]
            assert not np.any(follow.base.commands)
        else:
            assert (result["status"], result["code"]) == (SUCCEEDED, 0)
            assert 0.2 * limits.v < np.array(follow.base.commands)[:, 0].max() < 0.85 * limits.v
