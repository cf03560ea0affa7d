"""A costmap and moving things by topics, over DDS."""

import numpy as np
import pytest
from ros_parts import stack

from diffdrive_mpc.mpc import Mode
from diffdrive_mpc.mpc.config.free_space import FreeSpace

pytest.importorskip("rclpy")

from nav_msgs.msg import OccupancyGrid
from rclpy.qos import qos_profile_sensor_data
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2, PointField

from diffdrive_mpc.mpc.ros.conversions import MessageError, time_message
from diffdrive_mpc.mpc.ros.surroundings_input import read_costmap, read_obstacles

SEEING = {"free_space.enabled": True}


def costmap(now, wall=None):
    """6 m by 6 m around the origin, with a wall at x [m]."""
    message = OccupancyGrid()
    message.header.frame_id, message.header.stamp = "odom", time_message(now)
    message.info.resolution, message.info.width, message.info.height = 0.05, 120, 120
    message.info.origin.position.x = message.info.origin.position.y = -3.0
    message.info.origin.orientation.w = 1.0
    cells = np.zeros((120, 120), dtype=np.int8)
    if wall is not None:
        column = int((wall + 3.0) / 0.05)
        cells[:, column : column + 4] = 100
    message.data = cells.ravel().tolist()
    return message


def cloud(now, rows, names=("x", "y", "radius", "vx", "vy")):
    message = PointCloud2(height=1, width=len(rows), point_step=8 * len(names))
    message.header.frame_id, message.header.stamp = "odom", time_message(now)
    message.fields = [PointField(name=n, offset=8 * i, datatype=8, count=1) for i, n in enumerate(names)]
    message.data = np.asarray(rows, dtype=float).tobytes()
    return message


def test_a_costmap_is_read_as_rectangles():
    found = read_costmap(serialize_message(costmap(5, wall=1.0)), FreeSpace())
    assert found.grid.boxes.shape == (1, 4, 2)
    assert found.grid.boxes[0].min(axis=0) == pytest.approx([1.0, -3.0])
    assert found.grid.boxes[0].max(axis=0) == pytest.approx([1.2, 3.0])
    assert (found.frame, found.stamp) == ("odom", 5)


def test_points_are_read_as_discs():
    found = read_obstacles(serialize_message(cloud(7, [[1.0, 2.0, 0.3, 0.4, -0.5]])))
    assert found.discs.tolist() == [[1.0, 2.0, 0.3, 0.4, -0.5]]
    standing = read_obstacles(serialize_message(cloud(7, [[1.0, 2.0, 0.3]], ("x", "y", "radius"))))
    assert standing.discs.tolist() == [[1.0, 2.0, 0.3, 0.0, 0.0]]
    assert read_obstacles(serialize_message(cloud(7, []))).discs.shape == (0, 5)


def test_bad_points_are_refused_with_a_reason():
    for message, reason in (
        (cloud(0, [[0.0, 0.0]], ("x", "y")), "no field radius"),
        (cloud(0, [[np.nan, 0.0, 0.2, 0.0, 0.0]]), "not finite"),
        (cloud(0, np.zeros((501, 5))), "501 points"),
    ):
        with pytest.raises(MessageError, match=reason):
            read_obstacles(serialize_message(message))
    short = cloud(0, [[0.0, 0.0, 0.2, 0.0, 0.0]])
    short.data = bytes(short.data)[:-1]
    with pytest.raises(MessageError, match="length"):
        read_obstacles(serialize_message(short))


def test_a_costmap_of_another_size_than_it_says_is_refused():
    message = costmap(0)
    message.info.width = 100
    with pytest.raises(MessageError, match="says 100 x 120"):
        read_costmap(serialize_message(message), FreeSpace())


def test_without_a_costmap_it_does_not_drive_and_with_one_it_stays_before_the_wall():
    with stack(SEEING, trajectory="s", drive=True, use_costmap=True) as s:
        base, seen = s.base, s.node._surroundings
        assert not base.run(20).any()
        assert "the surroundings are" in s.loop.last.message
        publisher = base.node.create_publisher(OccupancyGrid, "costmap", 1)
        base.until(lambda: publisher.get_subscription_count() > 0, "the subscription")

        def show(wall):
            count = seen.costmap.accepted
            publisher.publish(costmap(base.now, wall))
            base.until(lambda: seen.costmap.accepted > count, "the costmap to be read")

        commands = []
        for tick in range(60):
            if tick % 10 == 0:
                show(None)
            commands.append(base.step())
        assert np.abs(commands).max() > 0.1
        wall = base.plant.true_pose[0] + 0.6
        for tick in range(150):
            if tick % 10 == 0:
                show(wall)
            base.step()
            assert base.plant.true_pose[0] + 0.25 < wall
        assert "the reference" in s.loop.last.message or s.loop.last.mode == Mode.STOPPED
        # Nobody tells any more.
        show(None)
        base.run(60)
        assert s.loop.last.mode == Mode.STOPPED
        assert "s old; free_space.max_age" in s.loop.last.message
        assert "old" in seen.fault


def test_large_messages_are_not_read_and_bad_ones_are_named():
    with stack(SEEING, trajectory="s", use_costmap=True, use_obstacles=True) as s:
        base, seen = s.base, s.node._surroundings
        seen.take_costmap(bytes(300_000))
        assert "300000 bytes" in seen.costmap.last_refusal
        publisher = base.node.create_publisher(PointCloud2, "obstacles", qos_profile_sensor_data)
        base.until(lambda: publisher.get_subscription_count() > 0, "the subscription")
        elsewhere = cloud(base.now, [[1.0, 2.0, 0.3, 0.0, 0.0]])
        elsewhere.header.frame_id = "map"
        publisher.publish(elsewhere)
        base.until(lambda: seen.obstacles.refused > 0, "the refusal")
        assert "frame_id is 'map'" in seen.obstacles.last_refusal


def test_topics_of_surroundings_need_a_controller_that_sees():
    with pytest.raises(ValueError, match=r"set free_space\.enabled"), stack(use_costmap=True):
        pass
