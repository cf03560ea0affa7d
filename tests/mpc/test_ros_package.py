"""Consistency of the files of the colcon package with the code: manifest, launch files and access control."""

import inspect
import re
import sys
import tomllib
import types
from pathlib import Path
from xml.etree import ElementTree

import pytest
import rclpy
from rclpy.context import Context
from ros_parts import stack
from rosgraph_msgs.msg import Clock

from diffdrive_mpc.sim import make_plant
from diffdrive_mpc.sim.ros.pace import WallClock
from diffdrive_mpc.sim.ros.run_robot import NODE_NAME
from diffdrive_mpc.sim.ros.simulated_base import SimulatedBase, load_base_settings
from diffdrive_mpc_monitor.command import monitor
from diffdrive_mpc_monitor.ros.node import CHECKED, UNCHECKED, MonitorNode, MonitorSettings
from imports import imports_of

ROOT = Path(__file__).parents[2]
ROS = ROOT / "ros"
MANIFEST = ElementTree.parse(ROS / "package.xml").getroot()
NODES = [
    path
    for room in ("mpc/ros", "packages/monitor/src/diffdrive_mpc_monitor/ros")
    for path in sorted((ROOT / room).glob("*.py"))
]
OPTIONAL_PACKAGES = {"bond", "nav2_msgs", "tf2_msgs"}
"""Optional packages of Nav2; without them the node runs and logs a message."""


def imported_packages(paths):
    return {module.partition(".")[0] for path in paths for module, _ in imports_of(path)}


def test_manifest_lists_every_imported_ros_package():
    dependencies = {element.text for element in MANIFEST.findall("exec_depend")}
    sources = [*NODES, *(ROOT / "sim").glob("ros/*.py"), *(ROS / "launch").glob("*.py")]
    ros = {
        name
        for name in imported_packages(sources)
        if name == "rclpy" or name.startswith("launch") or name.endswith(("_msgs", "_srvs"))
    }
    assert "rclpy" in ros
    assert ros | OPTIONAL_PACKAGES <= dependencies
    assert MANIFEST.get("format") == "3"
    assert MANIFEST.findtext("export/build_type") == "ament_python"


def test_extra_ros_installs_every_imported_ros_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extra = {re.split(r"[<>=]", name)[0] for name in project["optional-dependencies"]["ros"]}
    result = imported_packages(NODES)
    # rclpy contains these interfaces.
    builtin = {"builtin_interfaces", "rcl_interfaces"}
    for name in result - builtin - OPTIONAL_PACKAGES:
        if name == "rclpy" or name.endswith(("_msgs", "_srvs")):
            assert f"ros-jazzy-{name.replace('_', '-')}" in extra
    assert MANIFEST.findtext("version") == project["version"]


class RecordingModule(types.ModuleType):
    """Stub of a module of the ROS launch system, which has no wheel: each attribute returns the record of its call."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *arguments, **options: (name, arguments, options)


def launch_entities(monkeypatch, name):
    """Return the entities that a launch file starts."""
    for module in ("launch", "launch.actions", "launch.conditions", "launch.substitutions", "launch_ros.actions"):
        monkeypatch.setitem(sys.modules, module, RecordingModule(module))
    monkeypatch.setitem(sys.modules, "launch_ros", RecordingModule("launch_ros"))
    package_module = RecordingModule("ament_index_python.packages")
    package_module.get_package_share_directory = lambda _: str(ROS)
    monkeypatch.setitem(sys.modules, "ament_index_python", RecordingModule("ament_index_python"))
    monkeypatch.setitem(sys.modules, "ament_index_python.packages", package_module)
    path = ROS / "launch" / f"{name}.launch.py"
    namespace = {}
    exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), namespace)
    _, (started,), _ = namespace["generate_launch_description"]()
    return started


def test_monitored_launch_connects_the_base_to_the_monitor_only(monkeypatch):
    """The node publishes on the monitor's input topic; arguments of the monitor are options of its command line."""
    started_entities = launch_entities(monkeypatch, "monitored")
    (node,) = [arguments for kind, _, arguments in started_entities if kind == "LifecycleNode"]
    assert node["remappings"] == [(CHECKED, UNCHECKED)]
    commands = [arguments["cmd"] for kind, _, arguments in started_entities if kind == "ExecuteProcess"]
    assert [arguments[1] for arguments in commands] == ["sim-robot", "monitor"]
    assert commands[1][:3] == ["diffdrive-mpc", "monitor", "--rules"]
    assert "rules" in inspect.signature(monitor).parameters
    # Parameters that depend on launch arguments are Python expressions.
    expressions = [word[1][0] for word in commands[1] if word[0] == "PythonExpression"]
    texts = ["".join(part for part in parts if isinstance(part, str)) for parts in expressions]
    assert texts == ["'use_sim_time:=' + ''", "'use_pose_topic:=' + ''"]
    assert "use_pose_topic" in MonitorSettings.model_fields


# Access control: the policy permits exactly the topics and services of the nodes.


SECURITY = ROS / "security"
XI = "{http://www.w3.org/2001/XInclude}include"
RULES = {"topics": {"publish", "subscribe"}, "services": {"reply"}, "actions": {"execute"}}
KINDS = {"publish": "publisher", "subscribe": "subscriber", "reply": "service"}


def included(element):
    """Yield the children of an element; included files are replaced by their contents."""
    for child in element:
        if child.tag == XI:
            root = ElementTree.parse(SECURITY / child.get("href")).getroot()
            assert child.get("xpointer") == f"xpointer(/{root.tag}/*)"
            yield from included(root)
        else:
            yield child


def allowed(enclave):
    """Return pairs of rule and full name that an enclave of the policy allows."""
    root = ElementTree.parse(SECURITY / "policy.xml").getroot()
    assert (root.tag, root.get("version")) == ("policy", "0.2.0")
    (profiles,) = root.find(f"enclaves/enclave[@path='/diffdrive_mpc/{enclave}']")
    pairs = set()
    for profile in included(profiles):
        assert (profile.tag, profile.get("ns")) == ("profile", "/")
        for rules in included(profile):
            assert set(rules.attrib) <= RULES[rules.tag] and set(rules.attrib.values()) == {"ALLOW"}
            for entry in rules:
                assert entry.tag == rules.tag[:-1]
                name = re.sub("^~", profile.get("node"), entry.text)
                pairs |= {(rule, f"/{name}") for rule in rules.attrib}
    return pairs


def used_names(node, name=None):
    """Return the pairs of rule and full name that a running node uses; actions have special topics and services."""
    result = set()
    for rule, kind in KINDS.items():
        names = getattr(node, f"get_{kind}_names_and_types_by_node")(name or node.get_name(), "/")
        result |= {(rule, used) for used, _ in names}
    action = re.compile(r"(.*)/_action/")
    return {("execute", action.match(used)[1]) if "/_action/" in used else (rule, used) for rule, used in result}


PART_NAMES = {
    ("subscribe", "/battery_state"),
    ("subscribe", "/costmap"),
    ("subscribe", "/obstacles"),
    ("reply", "/diffdrive_mpc/predict_error"),
}
"""Topics and services of the parts in the package diffdrive-mpc-extras."""


def test_policy_allows_exactly_the_topics_of_the_node(ros_types):
    with stack(pose_source="tf") as s:
        result = used_names(s.node) | used_names(s.node, "diffdrive_mpc_follow_path") | PART_NAMES
    # With use_pose_topic, this topic replaces transforms.
    result.add(("subscribe", "/pose"))
    assert allowed("node") == result
    commands = {(rule, name) for rule, name in result if name.startswith(f"/{CHECKED}")}
    assert len(commands) == 2
    unchecked = {(rule, name.replace(CHECKED, UNCHECKED)) for rule, name in commands}
    assert allowed("monitored_node") == result - commands | unchecked


@pytest.mark.parametrize("enclave", ["monitor", "robot"])
def test_policy_allows_exactly_the_topics_of_monitor_and_robot(enclave):
    context = Context()
    rclpy.init(context=context, args=["--ros-args", "-p", "use_sim_time:=true"])
    try:
        if enclave == "monitor":
            node = MonitorNode(MonitorSettings(use_pose_topic=True), context=context)
        else:
            node = rclpy.create_node(NODE_NAME, context=context)
            settings, plant = load_base_settings(), make_plant("model:ssm", surface="ideal", sensors="perfect")
            SimulatedBase(node, plant, (0, 0, 0), settings, pose_memory=0, clock=WallClock(), record=print)
            node.create_publisher(Clock, "/clock", 1)
        assert allowed(enclave) == used_names(node)
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)
