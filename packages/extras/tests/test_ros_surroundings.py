"""Topics with a costmap and moving obstacles, over DDS."""

import math
import re
import time
from array import array
from types import SimpleNamespace

import numpy as np
import pytest
from nav_msgs.msg import OccupancyGrid
from rclpy.serialization import serialize_message
from ros_parts import stack
from sensor_msgs.msg import PointCloud2, PointField

from diffdrive_mpc.mpc import Controller, Mode
from diffdrive_mpc.mpc.config.config_file import load_config
from diffdrive_mpc.mpc.ros.conversions import MessageError, time_message
from diffdrive_mpc_extras.free_space.config import FreeSpace, free_space_of
from diffdrive_mpc_extras.free_space.surroundings import SurroundingsError
from diffdrive_mpc_extras.ros.surroundings_input import (
    SurroundingsInput,
    SurroundingsSettings,
    read_costmap,
    read_obstacles,
)
from refusals import one_line_error

FREE_SPACE = {"free_space.enabled": True}


def costmap(now, wall=None):
    """Build a costmap of 6 m by 6 m around the origin, with a wall at x [m]."""
    message = OccupancyGrid()
    message.header.frame_id, message.header.stamp = "odom", time_message(now)
    message.info.resolution, message.info.width, message.info.height = 0.05, 120, 120
    message.info.origin.position.x = message.info.origin.position.y = -3.0
    message.info.origin.orientation.w = 1.0
    cells = np.zeros((120, 120), dtype=np.int8)
    if wall is not None:
        column = int((wall + 3.0) / 0.05)
        cells[:, column : column + 4] = 100
    message.data = array("b", cells.tobytes())
    return message


def cloud(now, rows, names=("x", "y", "radius", "vx", "vy")):
    """Build a PointCloud2 with float64 fields."""
    message = PointCloud2(height=1, width=len(rows), point_step=8 * len(names))
    message.header.frame_id, message.header.stamp = "odom", time_message(now)
    message.fields = [PointField(name=n, offset=8 * i, datatype=8, count=1) for i, n in enumerate(names)]
    message.data = np.asarray(rows, dtype=float).tobytes()
    return message


def test_costmap_is_converted_to_rectangles():
    message = read_costmap(serialize_message(costmap(5, wall=1.0)), FreeSpace())
    assert message.grid.boxes.shape == (1, 4, 2)
    assert message.grid.boxes[0].min(axis=0) == pytest.approx([1.0, -3.0])
    assert message.grid.boxes[0].max(axis=0) == pytest.approx([1.2, 3.0])
    assert (message.frame, message.stamp) == ("odom", 5)


def test_points_are_converted_to_discs():
    message = read_obstacles(serialize_message(cloud(7, [[1.0, 2.0, 0.3, 0.4, -0.5]])))
    assert message.discs.tolist() == [[1.0, 2.0, 0.3, 0.4, -0.5]]
    static = read_obstacles(serialize_message(cloud(7, [[1.0, 2.0, 0.3]], ("x", "y", "radius"))))
    assert static.discs.tolist() == [[1.0, 2.0, 0.3, 0.0, 0.0]]
    assert read_obstacles(serialize_message(cloud(7, []))).discs.shape == (0, 5)


def change(**values):
    """Return a function that sets fields of a valid message; `__` in a name separates nested fields."""

    def apply(message):
        for name, value in values.items():
            *parents, field_name = name.split("__")
            part = message
            for parent in parents:
                part = getattr(part, parent)
            setattr(part, field_name, value)
        return message

    return apply


def cells_of(values):
    return change(data=array("b", np.resize(np.array(values, dtype=np.int8), 120 * 120).tobytes()))


def field(index, **values):
    def apply(message):
        change(**values)(message.fields[index])
        return message

    return apply


INVALID_GRIDS = {
    "width too small": (change(info__width=100), "its size is 100 x 120"),
    "size overflow": (change(info__width=2**32 - 1, info__height=2**32 - 1), "its size is 4294967295 x 4294967295"),
    "too large": (
        change(info__width=600, info__height=500, data=array("b", bytes(300_000))),
        "exceed the limit of 250,000|300[0-9]+ bytes",
    ),
    "origin NaN": (change(info__origin__position__x=math.nan), "not finite"),
    "no orientation": (change(info__origin__orientation__w=0.0), "not a unit quaternion"),
    "resolution 0": (change(info__resolution=0.0), "resolution 0.0 m"),
    "invalid cells": (cells_of([-128]), "cells from -128"),
    "too many pieces": (cells_of([*[100, 0] * 60, *[0] * 120]), "rectangles|pieces"),
    "frame": (change(header__frame_id="moon"), "frame_id is 'moon'"),
    "control characters": (change(header__frame_id="od\x1b[31m\nom"), "frame_id is"),
    "future": (change(header__stamp__sec=2**31 - 1), "in the future"),
    "past": (change(header__stamp__sec=-(2**31)), "before the last"),
}
INVALID_CLOUDS = {
    "no radius": (field(2, name="size"), "no field radius"),
    "too many points": (change(width=501), "501 points"),
    "size overflow": (change(width=2**32 - 1, height=2**32 - 1), "points; send at most the nearest 500"),
    "big-endian": (change(is_bigendian=True), "big-endian"),
    "offset overflow": (field(0, offset=2**32 - 1), "inside a point"),
    "invalid datatype": (field(0, datatype=0), "inside a point"),
    "NaN": (change(data=np.full(5, math.nan).tobytes()), "not finite"),
    "negative radius": (change(data=np.array([5, 5, -1, 0, 0.0]).tobytes()), "radius -1 m"),
    "too large": (change(data=bytes(100_000), width=2500), "bytes|2500 points"),
    "frame": (change(header__frame_id="moon"), "frame_id is 'moon'"),
    "future": (change(header__stamp__sec=2**31 - 1), "in the future"),
    "past": (change(header__stamp__sec=-(2**31)), "before the last"),
}
NODE_ERRORS = {"frame", "control characters", "future", "past"}
"""Errors of stamp and frame, which only the node detects."""
POINT = [[5.0, 5.0, 0.2, 0.0, 0.0]]


@pytest.mark.parametrize("name", sorted(INVALID_GRIDS.keys() - NODE_ERRORS))
def test_invalid_costmap_is_refused_in_one_line(name):
    corrupt, message = INVALID_GRIDS[name]
    with one_line_error((MessageError, SurroundingsError), match=message):
        read_costmap(serialize_message(corrupt(costmap(0))), FreeSpace())


@pytest.mark.parametrize("name", sorted(INVALID_CLOUDS.keys() - NODE_ERRORS))
def test_invalid_points_are_refused_in_one_line(name):
    corrupt, message = INVALID_CLOUDS[name]
    with one_line_error((MessageError, SurroundingsError), match=message):
        read_obstacles(serialize_message(corrupt(cloud(0, POINT))))


def test_invalid_messages_do_not_affect_driving_while_valid_messages_arrive(capfd):
    """Invalid messages at 20 Hz on both topics cause no exception, no missing command and few warnings."""
    with stack(
        FREE_SPACE,
        trajectory="s",
        drive=True,
        **{"parts.free_space.use_costmap": True, "parts.free_space.use_obstacles": True},
    ) as s:
        base, surroundings_input = s.base, s.node.parts["free_space"].surroundings
        topics = (
            (surroundings_input.costmap, s.publisher(OccupancyGrid, "costmap"), costmap, INVALID_GRIDS),
            (
                surroundings_input.obstacles,
                s.publisher(PointCloud2, "obstacles"),
                lambda now: cloud(now, POINT),
                INVALID_CLOUDS,
            ),
        )
        refusals = {topic_input.name: set() for topic_input, *_ in topics}
        queues = {topic_input.name: list(cases.values()) for topic_input, _, _, cases in topics}

        def send(publisher, message, topic_input, count):
            previous = getattr(topic_input, count)
            publisher.publish(message)
            base.until(lambda: getattr(topic_input, count) > previous, f"{topic_input.name} {count}")

        def drive(ticks, *, with_valid):
            """Send an invalid message in two of five ticks, and a valid message in every tenth tick."""
            for tick in range(ticks):
                for topic_input, publisher, message, _ in topics:
                    if with_valid and tick % 10 == 0:
                        send(publisher, message(base.now), topic_input, "accepted")
                    if tick % 5 in (1, 3):
                        corrupt, pattern = queues[topic_input.name][0]
                        queues[topic_input.name] = queues[topic_input.name][1:] + queues[topic_input.name][:1]
                        send(publisher, corrupt(message(base.now)), topic_input, "refused")
                        assert re.search(pattern, topic_input.last_refusal), (pattern, topic_input.last_refusal)
                        refusals[topic_input.name].add(pattern)
                base.step()
            return s.loop.last

        start = time.monotonic()
        assert drive(80, with_valid=True).mode == Mode.TRACKING
        assert base.commands[-1][0] > 0.1
        assert {name: len(patterns) for name, patterns in refusals.items()} == {
            topic_input.name: len({pattern for _, pattern in cases.values()}) for topic_input, _, _, cases in topics
        }
        max_warnings = 1 + (time.monotonic() - start) / 5.0
        output = capfd.readouterr().err
        for topic_input, *_ in topics:
            assert 1 <= output.count(f"{topic_input.name} refused") <= max_warnings
        assert "Traceback" not in output and "\x1b" not in output.replace("\x1b[0m", "").replace("\x1b[33m", "")
        last = drive(45, with_valid=False)
        assert last.mode == Mode.STOPPED and "the surroundings are" in last.message
        assert drive(60, with_valid=True).mode == Mode.TRACKING


def test_refused_combination_of_messages_does_not_count_as_fresh():
    """A wall and one disc are within max_pieces; with four discs the last valid combination stays in use."""
    controller = Controller(load_config("ssm", FREE_SPACE | {"free_space.max_pieces": 4}))
    inbox = SimpleNamespace(now=100.0, frame="odom", time_of=lambda stamp: stamp * 1e-9)
    side_process = SimpleNamespace(submit=lambda _, job, arguments, done, failed: done(job(*arguments)))
    messages = []
    surroundings_input = SurroundingsInput(
        SurroundingsSettings(use_costmap=True, use_obstacles=True), controller, inbox, side_process, messages.append
    )

    def send_discs(count):
        stamp = round(inbox.now * 1e9)
        surroundings_input.take_obstacles(serialize_message(cloud(stamp, count * POINT)))

    surroundings_input.take_costmap(serialize_message(costmap(round(inbox.now * 1e9), wall=1.0)))
    send_discs(1)
    assert not surroundings_input.fault and surroundings_input.obstacles.accepted == 1
    inbox.now += 0.9 * free_space_of(controller.config).max_age
    surroundings_input.take_costmap(serialize_message(costmap(round(inbox.now * 1e9), wall=1.0)))
    send_discs(4)
    assert "5 convex pieces" in messages[-1] and (
        surroundings_input.obstacles.accepted,
        surroundings_input.obstacles.refused,
    ) == (1, 1)
    inbox.now += 0.2 * free_space_of(controller.config).max_age
    assert "obstacles is" in surroundings_input.fault and "costmap" not in surroundings_input.fault
    send_discs(1)
    assert not surroundings_input.fault


def test_robot_waits_for_the_costmap_and_stops_before_the_wall():
    with stack(FREE_SPACE, trajectory="s", drive=True, **{"parts.free_space.use_costmap": True}) as s:
        base, surroundings_input = s.base, s.node.parts["free_space"].surroundings
        assert not base.run(20).any()
        assert "the surroundings are" in s.loop.last.message
        publisher = s.publisher(OccupancyGrid, "costmap")

        def send_costmap(wall):
            count = surroundings_input.costmap.accepted
            publisher.publish(costmap(base.now, wall))
            base.until(lambda: surroundings_input.costmap.accepted > count, "the costmap to be read")

        commands = []
        for tick in range(60):
            if tick % 10 == 0:
                send_costmap(None)
            commands.append(base.step())
        assert np.abs(commands).max() > 0.1
        wall = base.plant.true_pose[0] + 0.6
        for tick in range(150):
            if tick % 10 == 0:
                send_costmap(wall)
            base.step()
            assert base.plant.true_pose[0] + 0.25 < wall
        assert "the reference" in s.loop.last.message or s.loop.last.mode == Mode.STOPPED
        # The last costmap becomes too old.
        send_costmap(None)
        base.run(60)
        assert s.loop.last.mode == Mode.STOPPED
        assert "s old; free_space.max_age" in s.loop.last.message
        assert "old" in surroundings_input.fault


def test_topics_of_surroundings_require_free_space_enabled():
    with (
        pytest.raises(ValueError, match=r"set free_space\.enabled"),
        stack(**{"parts.free_space.use_costmap": True}),
    ):
        pass


def test_parameters_enable_the_feature_free_space():
    """ROS ignores a parameter that no node declares."""
    with stack(**{"expert.free_space.enabled": True, "expert.free_space.max_pieces": 4}) as s:
        group = free_space_of(s.node.parts["free_space"].require_tools().controller.config)
    assert group.enabled and group.max_pieces == 4
