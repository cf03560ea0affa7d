"""Parts of the node: their parameters, their hooks, and the packages that contain them."""

from types import SimpleNamespace

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from pydantic import Field
from rclpy.parameter import Parameter
from ros_parts import stack

from diffdrive_mpc.models import plug_ins
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.errors import MissingPackageError
from diffdrive_mpc.models.logs.drive_log.reader import read_drive_log
from diffdrive_mpc.mpc.ros.control_loop import RefusedError
from diffdrive_mpc.mpc.ros.node_part import NodePart
from diffdrive_mpc.mpc.ros.parameters import declare, read, with_parts
from diffdrive_mpc.mpc.ros.settings import NodeSettings, PartSettings


class ProbeSettings(PartSettings):
    """Settings of the probe."""

    refuse: bool = Field(False, description="refuse to be configured [-]")
    refuse_activation: bool = Field(False, description="refuse to be activated [-]")
    current: float = Field(1.5, gt=0, le=10, description="current in each row [A]")


class Probe(NodePart):
    """Part that records the order of its hook calls."""

    schema = ProbeSettings
    fault = "the probe has a fault"

    def __init__(self, node):
        super().__init__(node)
        self.calls = []

    def configure(self, tools):
        self.settings = tools.part_settings(ProbeSettings)
        if self.settings.refuse:
            raise RefusedError("the probe refuses to be configured")
        self.calls.append("configure")

    def check_activation(self):
        if self.settings.refuse_activation:
            raise RefusedError("the probe refuses to be activated")
        self.calls.append("check")

    def activate(self):
        assert self.loop is not None
        self.calls.append("activate")

    def tick(self, tick):
        self.calls.append("tick")

    def after_tick(self, tick, time, row):
        self.calls.append("after tick")
        row["battery_current_a"] = self.settings.current

    def deactivate(self):
        assert self.loop is None
        self.calls.append("deactivate")

    def tear_down(self):
        assert self.tools is None
        self.calls.append("tear down")

    def change_limits(self):
        self.calls.append("limits")

    def diagnostics(self):
        return {"probe": "ready"}


@pytest.fixture
def parts(monkeypatch):
    """Installed parts by name; a test may add parts."""
    installed = {"probe": SimpleNamespace(name="probe", load=lambda: Probe)}
    monkeypatch.setattr(plug_ins, "_entries", lambda group: installed if group == "node_parts" else {})
    plug_ins.plug_in.cache_clear()
    yield installed
    plug_ins.plug_in.cache_clear()


class StubNode:
    """Stub of a node with parameter overrides, for the declaration of parameters."""

    def __init__(self, **overrides):
        self.known, self.warnings = {}, []
        self._parameter_overrides = {
            name: Parameter(name, value=value)
            for name, value in ((name.replace("__", "."), value) for name, value in overrides.items())
        }

    def declare_parameters(self, _, parameters):
        self.known |= {name: self._parameter_overrides.get(name, Parameter(name, value=v)) for name, v, _ in parameters}

    def get_parameter(self, name):
        return self.known[name]

    def get_logger(self):
        return SimpleNamespace(warning=self.warnings.append)


def test_parameters_of_a_configured_part_are_declared_and_read(parts):
    node = StubNode(parts__probe__current=2.5)
    settings = with_parts(node, NodeSettings(), ())
    declare(node, settings)
    assert {name for name in node.known if name.startswith("parts.")} == {
        f"parts.probe.{key}" for key in ("enabled", "refuse", "refuse_activation", "current")
    }
    assert read(node, settings).parts == {"probe": ProbeSettings(current=2.5)}
    with pytest.raises(ConfigError, match=r"parts\.probe.*current"):
        read(node, settings, {"parts.probe.current": 20.0})


def test_part_of_a_configured_feature_is_loaded_and_unnamed_parts_are_not(parts):
    parts["unused"] = SimpleNamespace(name="unused", load=lambda: pytest.fail("an unnamed part is loaded"))
    assert with_parts(StubNode(), NodeSettings(), ()).parts == {}
    assert with_parts(StubNode(), NodeSettings(), ("probe", "feature_without_part")).parts == {"probe": ProbeSettings()}
    settings = NodeSettings(parts={"probe": {"current": 3.0}})
    assert with_parts(StubNode(), settings, ("probe",)).parts == {"probe": ProbeSettings(current=3.0)}


def test_error_for_a_missing_part_contains_its_package(parts):
    with pytest.raises(MissingPackageError, match=r"^node part 'energy' is in the package diffdrive-mpc-extras: pip "):
        with_parts(StubNode(parts__energy__use_battery=True), NodeSettings(), ())
    with pytest.raises(MissingPackageError, match=r"^node part 'mine': no installed package has it"):
        NodeSettings(parts={"mine": {}})


def test_hooks_are_called_in_the_order_of_the_lifecycle(parts, tmp_path):
    with stack(drive=True, record=True, record_folder=str(tmp_path), **{"parts.probe.current": 2.5}) as s:
        probe, statuses = s.node.parts["probe"], []
        s.base.node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: statuses.append(m.status[0]), 10)
        s.base.run(30)
        s.node.set_parameters([Parameter("limits.v", value=0.4)])
        s.base.until(lambda: statuses and s.node.parts["recording"].recording.incomplete is False, "diagnostics")
        assert statuses[-1].level == DiagnosticStatus.WARN and "the probe has a fault" in statuses[-1].message
        assert {pair.key: pair.value for pair in statuses[-1].values}["probe"] == "ready"
        s.node.trigger_deactivate()
        s.node.trigger_cleanup()
        s.base.silent(3)
        assert s.base.silent(3) == 0
    calls = probe.calls
    assert calls[:3] == ["configure", "check", "activate"] and calls[-2:] == ["deactivate", "tear down"]
    ticks = [name for name in calls if name.endswith("tick")]
    assert len(ticks) >= 60 and ticks == ["tick", "after tick"] * (len(ticks) // 2)
    assert calls.count("limits") == 1
    (path,) = tmp_path.iterdir()
    assert (read_drive_log(path).columns["battery_current_a"] == 2.5).all()


@pytest.mark.parametrize("hook", ["refuse", "refuse_activation"])
def test_node_recovers_after_a_transition_that_a_part_rejects(parts, hook):
    with stack(autostart=False, **{f"parts.probe.{hook}": True}) as s:
        s.node.trigger_configure()
        if hook == "refuse_activation":
            s.node.trigger_activate()
        assert "the probe refuses to be" in s.node.failure and s.node._loop is None
        s.node.set_parameters([Parameter(f"parts.probe.{hook}", value=False)])
        if hook == "refuse":
            s.node.trigger_configure()
        s.node.trigger_activate()
        s.await_inputs()
        assert s.node.label == "active"
