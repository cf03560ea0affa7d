"""Node, monitor and simulated robot as three processes: the monitor is killed while they drive."""

import time

import numpy as np
import pytest
from test_over_dds import BOUND, true_twists
from two_processes import own_domain, running

from diffdrive_mpc.models.logs.bag_topics import COMMANDS, opened, read_topic
from diffdrive_mpc.models.logs.mapping import Topic


@pytest.mark.long
def test_a_robot_stops_by_itself_when_its_monitor_is_killed(tmp_path, monkeypatch):
    """The controller goes on to command, nobody forwards it, and the base's own timeout acts."""
    environment, bag = own_domain(tmp_path), tmp_path / "bag"
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    in_sim_time = ["--ros-args", "-p", "use_sim_time:=true", "-p", "use_pose_topic:=true"]
    node = ["node", "--drive", *in_sim_time, "-r", "cmd_vel:=cmd_vel_unchecked"]
    # Long: a busy machine must not make commands late, which the monitor would stop. Once the dead monitor's lease of
    # DDS has ended nobody is connected any more, and the robot waits no longer.
    robot = ["sim-robot", "--lock-step", "--answer-timeout", "12", "--record", str(bag)]
    with (
        running("node", node, environment, tmp_path) as controller,
        running("monitor", ["monitor", *in_sim_time], environment, tmp_path) as monitor,
        running("robot", robot, environment, tmp_path) as base,
        true_twists(environment) as following,
    ):
        end = time.monotonic() + BOUND
        while following()[0] < 0.3:
            assert all(one.popen.poll() is None for one in (controller, monitor, base))
            assert "STOPPED" not in monitor.output, monitor.output
            assert time.monotonic() < end, (controller.output, monitor.output, base.output)
        monitor.popen.kill()
        while np.abs(following()).max() > 0.01:
            assert controller.popen.poll() is None and base.popen.poll() is None
        assert "no command on /cmd_vel for 0.5 s: the robot stops" in base.output
    with opened(bag) as reader:
        commands = read_topic(reader, bag, Topic(topic="/cmd_vel"), COMMANDS)
        truth = read_topic(reader, bag, Topic(topic="/ground_truth/twist"), COMMANDS)
    since = 1e-9 * (truth.stamped - commands.received[-1])
    assert commands.value[-1, 0] > 0.2
    assert 0.5 < since[-1] < 1.5
