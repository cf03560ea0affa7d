"""Features of a controller from entry points, with their configuration groups."""

import pickle
from dataclasses import replace
from types import SimpleNamespace

import pytest
import yaml
from pydantic import Field

from diffdrive_mpc import ConfigError, Controller, ControllerConfig, load_config, load_trajectory, make_plant, simulate
from diffdrive_mpc.models import plug_ins
from diffdrive_mpc.mpc.config.described import commented_yaml
from diffdrive_mpc.mpc.config.group import FeatureGroup, Positive
from diffdrive_mpc.mpc.features.feature import Feature
from diffdrive_mpc.mpc.hold import Hold
from refusals import one_line_error

ON = {"expert.lunch.enabled": True}


@pytest.fixture(autouse=True)
def lunch(monkeypatch):
    """Register the feature as that of an installed package."""
    groups = {"features": {"lunch": SimpleNamespace(load=lambda: LunchFeature)}}
    monkeypatch.setattr(plug_ins, "_entries", lambda group: groups.get(group, {}))
    plug_ins.plug_in.cache_clear()
    yield
    plug_ins.plug_in.cache_clear()


def drive(overrides):
    controller = Controller(load_config("sm", overrides))
    return simulate(controller, make_plant("model:sm"), load_trajectory("circle"))


def test_feature_holds_the_robot_and_changes_the_result():
    run = drive(ON)
    is_held = (run.time > 2.0) & (run.time < 3.0)
    assert abs(run.command[is_held]).max() < 1e-9
    assert abs(run.command[run.time > 3.5]).max() > 0.3
    assert run.messages[0].endswith("step 1")
    assert run.metrics.completed


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("lunch", "feature 'lunch' is not enabled: set expert.lunch.enabled to true"),
        ("rehearsal", "'rehearsal' is in the package diffdrive-mpc-extras: pip install"),
    ],
)
def test_missing_feature_raises_config_error(name, message):
    with pytest.raises(ConfigError, match=message):
        Controller("sm").feature(name)


def test_group_of_a_feature_is_read_written_and_compared(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("model: sm\nexpert: {lunch: {end: 2.5}}\n")
    config = load_config(path)
    assert config.features["lunch"].end == 2.5
    assert pickle.loads(pickle.dumps(config)) == config != load_config("sm")
    assert yaml.safe_load(commented_yaml(config))["expert"]["lunch"] == {"enabled": False, "end": 2.5, "menu": ""}
    path.write_text(commented_yaml(config))
    assert load_config(path) == config
    dumped = config.model_dump(mode="json")
    assert dumped["lunch"]["end"] == 2.5
    assert load_config(dumped) == ControllerConfig.model_validate(dumped) == config
    assert config.model_dump(exclude_defaults=True) == {"model": "sm", "lunch": {"end": 2.5}}


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"lunch.ende": 1.0}, "unknown key 'expert.lunch.ende'; did you mean 'expert.lunch.end'"),
        ({"expert.lunch.end": -1.0}, "expert.lunch.end: .*greater than 0.*-1.0"),
        ({"rehearsal.enabled": True}, "feature 'rehearsal' is in the package diffdrive-mpc-extras: pip install"),
    ],
)
def test_mistake_in_a_feature_raises_error_with_key_and_remedy(overrides, message):
    with one_line_error(ConfigError, match=message):
        load_config("sm", overrides)


class Lunch(FeatureGroup):
    """Group `expert.lunch`."""

    enabled: bool = Field(False, description="stand for lunch [-]")
    end: Positive = Field(3.0, description="end of lunch [s]")
    menu: str = Field("", description="file of the menu [-]")

    def relative_to(self, folder):
        """Return the group with the menu in `folder`."""
        return self.model_copy(update={"menu": str(folder / self.menu)}) if self.menu else self


class LunchFeature(Feature):
    """Feature that holds the robot from 1 s to the end of lunch and counts its steps."""

    schema = Lunch

    def attach(self, host):
        super().attach(host)
        self.steps = 0

    def before_step(self, t):
        self.steps += 1
        return Hold("lunch") if 1.0 <= t < self.host.config.features["lunch"].end else None

    def after_step(self, t, measurement, result):
        return replace(result, message=f"{result.message}; step {self.steps}".removeprefix("; "))

    def state(self):
        return self.steps

    def restore(self, state):
        self.steps = state
