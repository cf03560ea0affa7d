"""The files of the colcon package fit the code that they start."""

import inspect
import re
import sys
import tomllib
import types
from importlib import import_module
from pathlib import Path
from xml.etree import ElementTree

import pytest
import rclpy
import yaml
from rclpy.context import Context
from ros_parts import stack

from diffdrive_mpc.app.commands.ros import monitor
from diffdrive_mpc.mpc.monitor.ros.node import CHECKED, UNCHECKED, MonitorSettings
from diffdrive_mpc.mpc.ros.node import TrackingNode
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from imports import imported

ROOT = Path(__file__).parents[2]
ROS = ROOT / "ros"
MANIFEST = ElementTree.parse(ROS / "package.xml").getroot()
NODES = [path for room in ("mpc/ros", "mpc/monitor/ros") for path in sorted((ROOT / room).glob("*.py"))]
NAME = MANIFEST.findtext("name")
WITHOUT_WHEEL = {"bond", "nav2_msgs", "tf2_msgs"}
"""Used where they are installed, as with Nav2; the node does without them, and says so."""


def packages(paths):
    return {module.partition(".")[0] for path in paths for module, _ in imported(path)}


def test_the_manifest_names_every_ros_package_that_the_code_imports():
    listed = {element.text for element in MANIFEST.findall("exec_depend")}
    sources = [*NODES, *(ROOT / "sim").glob("ros/*.py"), *(ROS / "launch").glob("*.py")]
    ros = {
        name
        for name in packages(sources)
        if name == "rclpy" or name.startswith("launch") or name.endswith(("_msgs", "_srvs"))
    }
    assert "rclpy" in ros
    assert ros | WITHOUT_WHEEL <= listed
    assert MANIFEST.get("format") == "3"
    assert MANIFEST.findtext("export/build_type") == "ament_python"


def test_the_extra_installs_every_ros_package_that_the_node_imports():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extra = {re.split(r"[<>=]", name)[0] for name in project["optional-dependencies"]["ros"]}
    found = packages(NODES)
    # rclpy itself brings the interfaces that it is made of.
    own = {"builtin_interfaces", "rcl_interfaces"}
    for name in found - own - WITHOUT_WHEEL:
        if name == "rclpy" or name.endswith(("_msgs", "_srvs")):
            assert f"ros-jazzy-{name.replace('_', '-')}" in extra
    assert MANIFEST.findtext("version") == project["version"]


def test_what_setup_installs_is_there(monkeypatch):
    calls = {}
    monkeypatch.setattr("setuptools.setup", calls.update)
    monkeypatch.chdir(ROS)
    exec(compile((ROS / "setup.py").read_text(), str(ROS / "setup.py"), "exec"), {"__file__": str(ROS / "setup.py")})
    installed = {name for _, names in calls["data_files"] for name in names}
    assert all((ROS / name).is_file() for name in installed)
    launched = {f"launch/{name}.launch.py" for name in ("node", "simulated", "monitored")}
    expected = launched | {"config/node.yaml", "config/tracking.rviz"}
    assert expected | {"package.xml", f"resource/{NAME}"} == installed
    entry = calls["entry_points"]["console_scripts"][0]
    name, module, function = re.fullmatch(r"(\w+) = ([\w.]+):(\w+)", entry).groups()
    assert callable(getattr(import_module(module), function))
    for launch in (ROS / "launch").glob("*.py"):
        text = launch.read_text(encoding="utf-8")
        assert all(found == name for found in re.findall(r'package="diffdrive_mpc_ros",\s*executable="(\w+)"', text))
    assert f"lib/{NAME}" in (ROS / "setup.cfg").read_text(encoding="utf-8")


def test_the_parameter_file_fits_the_node():
    context = Context()
    rclpy.init(context=context, args=["--ros-args", "--params-file", str(ROS / "config" / "node.yaml")])
    node = TrackingNode(context=context)
    given = yaml.safe_load((ROS / "config" / "node.yaml").read_text())["diffdrive_mpc"]["ros__parameters"]
    try:
        assert set(given) <= set(NodeSettings.model_fields)
        assert {name: node.get_parameter(name).value for name in given} == given
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


def test_rviz_shows_topics_that_exist():
    text = (ROS / "config" / "tracking.rviz").read_text(encoding="utf-8")
    with stack() as s:
        known = dict(s.node.get_topic_names_and_types())
        kinds = {
            "Path": "nav_msgs/msg/Path",
            "Marker": "visualization_msgs/msg/Marker",
            "Odometry": "nav_msgs/msg/Odometry",
        }
        shown = [item for item in yaml.safe_load(text)["Visualization Manager"]["Displays"] if "Topic" in item]
        assert len(shown) == 4
        for item in shown:
            assert known[item["Topic"]["Value"]] == [kinds[item["Class"].rpartition("/")[2]]]


@pytest.mark.parametrize(
    ("word", "line"),
    [("config:=smm", "error: unknown configuration 'smm'"), ("horizon", "error: ROS cannot start with the arguments")],
)
def test_the_entry_point_ends_bad_arguments_in_one_line(monkeypatch, word, line):
    monkeypatch.setattr(sys, "argv", ["node", "--ros-args", "-p", word])
    with pytest.raises(SystemExit, match=line) as ended:
        import_module("diffdrive_mpc.mpc.ros.main").main()
    assert "\n" not in str(ended.value)


class Recorded(types.ModuleType):
    """Stands for a module of ROS's launch system, which has no wheel: every name makes a record of its call."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *arguments, **words: (name, arguments, words)


def entities(monkeypatch, name):
    """What a launch file starts, by kind."""
    for module in ("launch", "launch.actions", "launch.conditions", "launch.substitutions", "launch_ros.actions"):
        monkeypatch.setitem(sys.modules, module, Recorded(module))
    monkeypatch.setitem(sys.modules, "launch_ros", Recorded("launch_ros"))
    packages = Recorded("ament_index_python.packages")
    packages.get_package_share_directory = lambda _: str(ROS)
    monkeypatch.setitem(sys.modules, "ament_index_python", Recorded("ament_index_python"))
    monkeypatch.setitem(sys.modules, "ament_index_python.packages", packages)
    path = ROS / "launch" / f"{name}.launch.py"
    space = {}
    exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), space)
    _, (listed,), _ = space["generate_launch_description"]()
    return listed


def test_the_monitor_alone_commands_the_base(monkeypatch):
    """The node's commands go to the topic that the monitor reads, and its words are those of the command line."""
    listed = entities(monkeypatch, "monitored")
    (node,) = [words for kind, _, words in listed if kind == "LifecycleNode"]
    assert node["remappings"] == [(CHECKED, UNCHECKED)]
    started = [words["cmd"] for kind, _, words in listed if kind == "ExecuteProcess"]
    assert [words[1] for words in started] == ["sim-robot", "monitor"]
    assert started[1][:3] == ["diffdrive-mpc", "monitor", "--rules"]
    assert "rules" in inspect.signature(monitor).parameters
    # Parameters that depend on an argument are put together when it is launched.
    made = [word[1][0] for word in started[1] if word[0] == "PythonExpression"]
    texts = ["".join(part for part in parts if isinstance(part, str)) for parts in made]
    assert texts == ["'use_sim_time:=' + ''", "'use_pose_topic:=' + ''"]
    assert "use_pose_topic" in MonitorSettings.model_fields
