"""The files of the colcon package fit the code that they start."""

import ast
import re
import sys
import tomllib
from importlib import import_module
from pathlib import Path
from xml.etree import ElementTree

import pytest
import rclpy
import yaml
from rclpy.context import Context
from ros_parts import stack

from diffdrive_mpc.mpc.ros.node import TrackingNode
from diffdrive_mpc.mpc.ros.settings import NodeSettings

ROOT = Path(__file__).parents[2]
ROS = ROOT / "ros"
MANIFEST = ElementTree.parse(ROS / "package.xml").getroot()
NAME = MANIFEST.findtext("name")


def imported(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module.partition(".")[0]


def test_the_manifest_names_every_ros_package_that_the_code_imports():
    listed = {element.text for element in MANIFEST.findall("exec_depend")}
    sources = [*(ROOT / "mpc" / "ros").glob("*.py"), *(ROOT / "sim").glob("ros/*.py"), *(ROS / "launch").glob("*.py")]
    found = set().union(*(imported(path) for path in sources))
    ros = {name for name in found if name == "rclpy" or name.startswith("launch") or name.endswith(("_msgs", "_srvs"))}
    assert "rclpy" in ros
    assert ros <= listed
    assert MANIFEST.get("format") == "3"
    assert MANIFEST.findtext("export/build_type") == "ament_python"


def test_the_extra_installs_every_ros_package_that_the_node_imports():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extra = {re.split(r"[<>=]", name)[0] for name in project["optional-dependencies"]["ros"]}
    found = set().union(*(imported(path) for path in (ROOT / "mpc" / "ros").glob("*.py")))
    # rclpy itself brings the interfaces that it is made of.
    own = {"builtin_interfaces", "rcl_interfaces"}
    for name in found - own:
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
    expected = {"launch/node.launch.py", "launch/simulated.launch.py", "config/node.yaml", "config/tracking.rviz"}
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
