"""Robots with values stated by the manufacturer: a start for a configuration, never treated as identified."""

import pytest
import yaml
from log_parts import bag_topics, drive, write_bag

from diffdrive_mpc import ConfigError, identify, load_config
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.plug_ins import plug_in_names
from diffdrive_mpc.models.stated_robot import STATED_ROBOTS, load_stated_robot

CLEARPATH = {"odom": "platform/odom", "imu": "platform/sensors/imu_0/data", "cmd_vel": "cmd_vel"}


@pytest.fixture(scope="module")
def husky_bag(tmp_path_factory):
    """Bag with the topics of a Husky in its namespace, and another source of commands."""
    topics = bag_topics(drive(60.0), command="geometry_msgs/msg/TwistStamped")
    husky = {f"/a200_0001/{CLEARPATH[name[1:]]}": topic for name, topic in topics.items() if name[1:] in CLEARPATH}
    husky["/a200_0001/joy_teleop/cmd_vel"] = husky["/a200_0001/cmd_vel"]
    return write_bag(tmp_path_factory.mktemp("bag") / "drive", husky)


@pytest.fixture(scope="module")
def identification(husky_bag):
    return identify(husky_bag, robot="husky")


@pytest.mark.parametrize("name", STATED_ROBOTS.names)
def test_every_value_is_stated_with_a_source_and_its_revision(name):
    robot = load_stated_robot(name)
    assert robot.provenance == "stated"
    assert all("commit" in source or "read 20" in source for source in robot.sources.values())
    assert "identified" not in yaml.safe_dump(STATED_ROBOTS.read(name)[0])
    text = "\n".join(robot.lines())
    assert "dead time" in text
    assert all(source in text for source in robot.sources.values())


@pytest.mark.parametrize("name", STATED_ROBOTS.names)
def test_stated_values_form_a_configuration(name):
    robot = load_stated_robot(name)
    values = robot.bounds(1.1) | {key: entry.value for key, entry in robot.configuration().items()}
    config = load_config("kinematic", values)
    assert config.limits.v == robot.v.stated
    assert config.wheels.track == pytest.approx(
        robot.wheel_separation.stated * robot.wheel_separation_multiplier.stated, rel=1e-4
    )
    assert config.limits.predicted_v > config.limits.v


def test_turtlebot_has_its_safety_limit():
    """The firmware permits higher speeds only if the safety features are disabled."""
    assert "v 0.306 m/s (stated: safety)" in "\n".join(load_stated_robot("turtlebot4").lines())


def test_topics_are_in_the_namespace_of_the_odometry(husky_bag):
    log = read_log(husky_bag, load_stated_robot("husky").mapping())
    assert log.topics["command"][0] == "/a200_0001/cmd_vel"
    assert log.topics["odometry"][0] == "/a200_0001/platform/odom"
    assert log.topics["imu"][0] == "/a200_0001/platform/sensors/imu_0/data"


def test_two_robots_in_one_bag_raise_config_error_with_their_namespaces(tmp_path, husky_bag):
    topics = bag_topics(drive(8.0))
    odometry = {f"/{name}/platform/odom": topics["/odom"] for name in ("a", "b")}
    bag = write_bag(tmp_path / "both", odometry | {"/a/cmd_vel": topics["/cmd_vel"]})
    with pytest.raises(ConfigError, match="several namespaces have it: /a, /b"):
        read_log(bag, load_stated_robot("husky").mapping())


def test_limits_of_the_log_do_not_exceed_those_of_the_manufacturer(identification):
    limits = {setting.name: setting for setting in identification.configuration.groups["limits"]}
    # The log has up to 1.5 rad/s, the manufacturer permits 1.
    assert limits["omega"].value == 1.0
    assert "stated by the manufacturer" in limits["omega"].reason
    assert limits["v"].value < 1.0
    assert "stated" not in limits["v"].reason
    assert limits["omega_slew"].value == 1.0


def test_written_configuration_states_the_reason_of_each_value(identification, tmp_path):
    identification.write(tmp_path)
    config = load_config(tmp_path / "config.yaml")
    assert config.wheels.track == pytest.approx(1.04063, rel=1e-4)
    assert ("free_space" in config.features) == ("free_space" in plug_in_names("features"))
    assert "stated by the manufacturer of Clearpath Husky A200" in (tmp_path / "config.yaml").read_text()
    assert "/a200_0001/platform/odom" in (tmp_path / "node.yaml").read_text()
