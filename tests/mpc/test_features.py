"""A feature attaches by one hook: ten lines and a line in the registry."""

import sys
import types
from dataclasses import replace

import pytest

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant, simulate
from diffdrive_mpc.mpc.features import registry
from diffdrive_mpc.mpc.features.feature import Feature
from diffdrive_mpc.mpc.hold import Hold


class Lunch(Feature):
    """Stands between two times, and says at each step how often it was asked."""

    def attach(self, host):
        super().attach(host)
        self.asked = 0

    def before_step(self, t):
        self.asked += 1
        return Hold("lunch") if 1.0 <= t < 3.0 else None

    def after_step(self, t, measurement, result):
        return replace(result, message=f"{result.message}; asked {self.asked} times".removeprefix("; "))


@pytest.fixture
def lunch(monkeypatch):
    module = types.ModuleType("diffdrive_mpc.mpc.lunch.feature")
    module.FEATURE = Lunch
    monkeypatch.setitem(sys.modules, "diffdrive_mpc.mpc.lunch", types.ModuleType("diffdrive_mpc.mpc.lunch"))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    listed = registry.RegisteredFeature("lunch", lambda config: config.horizon == 31)
    monkeypatch.setattr(registry, "FEATURES", (*registry.FEATURES, listed))


def drive(horizon):
    controller = Controller(load_config("sm", {"horizon": horizon}))
    return simulate(controller, make_plant("model:sm"), load_trajectory("circle"))


@pytest.mark.usefixtures("lunch")
def test_a_feature_holds_the_robot_and_speaks():
    run = drive(31)
    standing = (run.time > 2.0) & (run.time < 3.0)
    assert abs(run.command[standing]).max() < 1e-9
    assert abs(run.command[run.time > 3.5]).max() > 0.3
    assert run.messages[0].endswith("asked 1 times")
    assert run.metrics.completed


@pytest.mark.usefixtures("lunch")
def test_a_configuration_that_does_not_ask_for_it_has_none():
    assert not any("asked" in message for message in drive(30).messages)


def test_only_what_is_asked_for_is_imported():
    assert registry.features_of(load_config("sm")) == {}
    asked = load_config("sm", {"rehearsal.enabled": True, "online_dead_time.enabled": True})
    assert list(registry.features_of(asked)) == ["online_dead_time", "rehearsal"]
