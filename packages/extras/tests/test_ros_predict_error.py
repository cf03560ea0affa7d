"""The service that predicts the error of the node's reference, over DDS."""

import json

import pytest
from ros_parts import stack
from std_srvs.srv import Trigger

from diffdrive_mpc import Controller
from diffdrive_mpc_extras.predicted_error import predict_error

PART = {"parts.predicted_error.enabled": True}


def test_it_answers_what_the_controller_predicts():
    with stack(trajectory="s", **{"parts.predicted_error.error_population": "own"}) as s:
        answer = s.trigger("predict_error")
        assert answer.success, answer.message
        predicted = json.loads(answer.message)
        expected = predict_error(Controller("ssm"), "s", "own")
        widest = expected.widest("lateral")
        assert (predicted["reference"], predicted["population"], predicted["warnings"]) == ("s", "own", [])
        assert predicted["lateral"]["words"] == widest.sentence
        assert predicted["lateral"]["everywhere"] == pytest.approx(expected.lateral.everywhere.max(), abs=1e-5)
        assert predicted["along"]["arc_length"] <= expected.arc_length[-1]


def test_no_tick_waits_for_an_answer_and_cleaning_up_gives_one(monkeypatch):
    service, asked = "/diffdrive_mpc/predict_error", []
    with stack(drive=True, **PART) as s:
        s.base.run(20)
        monkeypatch.setattr(s.node._aside, "submit", lambda *job: asked.append(job))
        client = s.base.node.create_client(Trigger, service)
        s.base.until(lambda: client.service_is_ready() and s.node.count_clients(service), "the service")
        future = client.call_async(Trigger.Request())
        s.base.until(lambda: asked, "the request")
        commands = s.base.run(10)
        assert not future.done() and commands[-1, 0] > 0.1
        asked.pop()[3]("what the side process answers")
        s.base.until(future.done, "the answer")
        assert (future.result().success, future.result().message) == (True, "what the side process answers")
        future = client.call_async(Trigger.Request())
        s.base.until(lambda: asked, "the request")
        s.node.trigger_deactivate()
        s.node.trigger_cleanup()
        s.base.until(future.done, "the answer")
        assert (future.result().success, future.result().message) == (False, "the node was deactivated and cleaned up")


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"autostart": False}, "the node is unconfigured; activate it first"),
        ({"trajectory": "''"}, "there is no reference yet"),
        ({"config": "kinematic"}, "provenance.origin is assumed"),
    ],
)
def test_it_says_why_nothing_is_predicted(parameters, words):
    with stack(**PART, **parameters) as s:
        answer = s.trigger("predict_error")
        assert not answer.success and words in answer.message


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        (
            {"config": "kinematic", "parts.predicted_error.follow_error_limit": 0.05},
            "follow_error_limit is set, and model 'kinematic': its",
        ),
        ({"parts.predicted_error.error_population": "mine"}, "unknown population 'mine': give drawn or own"),
        ({"parts.predicted_error.error_calibration": "/nowhere.yaml"}, "/nowhere.yaml"),
    ],
)
def test_what_cannot_be_predicted_with_is_refused_when_the_node_is_configured(parameters, words):
    with pytest.raises(ValueError, match=words), stack(**parameters):
        pass
