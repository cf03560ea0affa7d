"""A feature and its configuration group, registered as an installed package would register them."""

from dataclasses import replace

from pydantic import Field

from diffdrive_mpc.models import plug_ins
from diffdrive_mpc.mpc.config.group import FeatureGroup, Positive
from diffdrive_mpc.mpc.features.feature import Feature
from diffdrive_mpc.mpc.hold import Hold


class Lunch(FeatureGroup):
    """Group `expert.lunch`."""

    enabled: bool = Field(False, description="stand for lunch [-]")
    end: Positive = Field(3.0, description="end of lunch [s]")
    menu: str = Field("", description="file of the menu [-]")

    def relative_to(self, folder):
        """Return the group with the menu in `folder`."""
        return self.model_copy(update={"menu": str(folder / self.menu)}) if self.menu else self


class LunchFeature(Feature):
    """Holds the robot from 1 s to the end of lunch, and counts its steps."""

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


class Entry:
    """Entry point of a part."""

    def __init__(self, part):
        self.part = part

    def load(self):
        return self.part


def register(monkeypatch, **features):
    """Let `features` be the features of installed packages."""
    groups = {"features": {name: Entry(part) for name, part in sorted(features.items())}}
    monkeypatch.setattr(plug_ins, "_entries", lambda group: groups.get(group, {}))
    plug_ins.plug_in.cache_clear()
