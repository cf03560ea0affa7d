"""A costmap and moving things by topics, over DDS."""

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

SEEING = {"free_space.enabled": True}


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
    message = PointCloud2(height=1, width=len(rows), point_step=8 * len(names))
    message.header.frame_id, message.header.stamp = "odom", time_message(now)
    message.fields = [PointField(name=n, offset=8 * i, datatype=8, count=1) for i, n in enumerate(names)]
    message.data = np.asarray(rows, dtype=float).tobytes()
    return message


def test_a_costmap_is_read_as_rectangles():
    message = read_costmap(serialize_message(costmap(5, wall=1.0)), FreeSpace())
    assert message.grid.boxes.shape == (1, 4, 2)
    assert message.grid.boxes[0].min(axis=0) == pytest.approx([1.0, -3.0])
    assert message.grid.boxes[0].max(axis=0) == pytest.approx([1.2, 3.0])
    assert (message.frame, message.stamp) == ("odom", 5)


def test_points_are_read_as_discs():
    message = read_obstacles(serialize_message(cloud(7, [[1.0, 2.0, 0.3, 0.4, -0.5]])))
    assert message.discs.tolist() == [[1.0, 2.0, 0.3, 0.4, -0.5]]
    standing = read_obstacles(serialize_message(cloud(7, [[1.0, 2.0, 0.3]], ("x", "y", "radius"))))
    assert standing.discs.tolist() == [[1.0, 2.0, 0.3, 0.0, 0.0]]
    assert read_obstacles(serialize_message(cloud(7, []))).discs.shape == (0, 5)


def change(**values):
    """Set fields of a message, those of fields by names with `__`; the rest stays valid."""

    def apply(message):
        for name, value in values.items():
            *path, last = name.split("__")
            part = message
            for step in path:
                part = getattr(part, step)
            setattr(part, last, value)
        return message

    return apply


def cells_of(values):
    return change(data=array("b", np.resize(np.array(values, dtype=np.int8), 120 * 120).tobytes()))


def field(index, **values):
    def apply(message):
        change(**values)(message.fields[index])
        return message

    return apply


BAD_GRIDS = {
    "narrower": (change(info__width=100), "says 100 x 120"),
    "lying": (change(info__width=2**32 - 1, info__height=2**32 - 1), "says 4294967295 x 4294967295"),
    "large": (
        change(info__width=600, info__height=500, data=array("b", bytes(300_000))),
        "exceed the limit of 250,000|300[0-9]+ bytes",
    ),
    "origin NaN": (change(info__origin__position__x=math.nan), "not finite"),
    "no orientation": (change(info__origin__orientation__w=0.0), "not a unit quaternion"),
    "resolution 0": (change(info__resolution=0.0), "resolution 0.0 m"),
    "cells": (cells_of([-128]), "cells from -128"),
    "pieces": (cells_of([*[100, 0] * 60, *[0] * 120]), "rectangles|pieces"),
    "frame": (change(header__frame_id="moon"), "frame_id is 'moon'"),
    "words": (change(header__frame_id="od\x1b[31m\nom"), "frame_id is"),
    "future": (change(header__stamp__sec=2**31 - 1), "in the future"),
    "past": (change(header__stamp__sec=-(2**31)), "before the last"),
}
BAD_CLOUDS = {
    "no radius": (field(2, name="size"), "no field radius"),
    "many": (change(width=501), "501 points"),
    "lying": (change(width=2**32 - 1, height=2**32 - 1), "points; give 500"),
    "big-endian": (change(is_bigendian=True), "big-endian"),
    "offset": (field(0, offset=2**32 - 1), "inside a point"),
    "kind": (field(0, datatype=0), "inside a point"),
    "NaN": (change(data=np.full(5, math.nan).tobytes()), "not finite"),
    "negative radius": (change(data=np.array([5, 5, -1, 0, 0.0]).tobytes()), "radius -1 m"),
    "large": (change(data=bytes(100_000), width=2500), "bytes|2500 points"),
    "frame": (change(header__frame_id="moon"), "frame_id is 'moon'"),
    "future": (change(header__stamp__sec=2**31 - 1), "in the future"),
    "past": (change(header__stamp__sec=-(2**31)), "before the last"),
}
OF_THE_NODE = {"frame", "no frame", "words", "future", "past"}
"""Errors of time and place, which the reader of a message cannot detect."""
POINT = [[5.0, 5.0, 0.2, 0.0, 0.0]]


@pytest.mark.parametrize("name", sorted(BAD_GRIDS.keys() - OF_THE_NODE))
def test_a_bad_costmap_is_refused_in_one_line(name):
    spoil, words = BAD_GRIDS[name]
    with one_line_error((MessageError, SurroundingsError), match=words):
        read_costmap(serialize_message(spoil(costmap(0))), FreeSpace())


@pytest.mark.parametrize("name", sorted(BAD_CLOUDS.keys() - OF_THE_NODE))
def test_bad_points_are_refused_in_one_line(name):
    spoil, words = BAD_CLOUDS[name]
    with one_line_error((MessageError, SurroundingsError), match=words):
        read_obstacles(serialize_message(spoil(cloud(0, POINT))))


def test_bad_messages_between_honest_ones_change_nothing_and_alone_they_stop_the_robot(capfd):
    """At 20 Hz on both topics, while the robot drives: no exception, a command for each tick, few warnings."""
    with stack(
        SEEING,
        trajectory="s",
        drive=True,
        **{"parts.free_space.use_costmap": True, "parts.free_space.use_obstacles": True},
    ) as s:
        base, surroundings_input = s.base, s.node.parts["free_space"].surroundings
        topics = (
            (surroundings_input.costmap, s.publisher(OccupancyGrid, "costmap"), costmap, BAD_GRIDS),
            (
                surroundings_input.obstacles,
                s.publisher(PointCloud2, "obstacles"),
                lambda now: cloud(now, POINT),
                BAD_CLOUDS,
            ),
        )
        heard = {watch.name: set() for watch, *_ in topics}
        turns = {watch.name: list(bad.values()) for watch, _, _, bad in topics}

        def send(publisher, message, watch, count):
            before = getattr(watch, count)
            publisher.publish(message)
            base.until(lambda: getattr(watch, count) > before, f"{watch.name} {count}")

        def drive(ticks, *, honest):
            """Send an invalid message each second or third tick, a valid one each tenth."""
            for tick in range(ticks):
                for watch, publisher, message, _ in topics:
                    if honest and tick % 10 == 0:
                        send(publisher, message(base.now), watch, "accepted")
                    if tick % 5 in (1, 3):
                        spoil, words = turns[watch.name][0]
                        turns[watch.name] = turns[watch.name][1:] + turns[watch.name][:1]
                        send(publisher, spoil(message(base.now)), watch, "refused")
                        assert re.search(words, watch.last_refusal), (words, watch.last_refusal)
                        heard[watch.name].add(words)
                base.step()
            return s.loop.last

        began = time.monotonic()
        assert drive(80, honest=True).mode == Mode.TRACKING
        assert base.commands[-1][0] > 0.1
        assert {name: len(words) for name, words in heard.items()} == {
            watch.name: len({words for _, words in bad.values()}) for watch, _, _, bad in topics
        }
        most = 1 + (time.monotonic() - began) / 5.0
        output = capfd.readouterr().err
        for watch, *_ in topics:
            assert 1 <= output.count(f"{watch.name} refused") <= most
        assert "Traceback" not in output and "\x1b" not in output.replace("\x1b[0m", "").replace("\x1b[33m", "")
        # Nothing honest any more.
        last = drive(45, honest=False)
        assert last.mode == Mode.STOPPED and "the surroundings are" in last.message
        assert drive(60, honest=True).mode == Mode.TRACKING


def test_a_combination_that_is_refused_does_not_pass_for_fresh():
    """A wall and one disc fit; with four discs nothing that was told since the last good messages counts."""
    controller = Controller(load_config("ssm", SEEING | {"free_space.max_pieces": 4}))
    inbox = SimpleNamespace(now=100.0, frame="odom", time_of=lambda stamp: stamp * 1e-9)
    aside = SimpleNamespace(submit=lambda _, job, arguments, done, failed: done(job(*arguments)))
    messages = []
    surroundings_input = SurroundingsInput(
        SurroundingsSettings(use_costmap=True, use_obstacles=True), controller, inbox, aside, messages.append
    )

    def tell(count):
        stamp = round(inbox.now * 1e9)
        surroundings_input.take_obstacles(serialize_message(cloud(stamp, count * POINT)))

    surroundings_input.take_costmap(serialize_message(costmap(round(inbox.now * 1e9), wall=1.0)))
    tell(1)
    assert not surroundings_input.fault and surroundings_input.obstacles.accepted == 1
    inbox.now += 0.9 * free_space_of(controller.config).max_age
    surroundings_input.take_costmap(serialize_message(costmap(round(inbox.now * 1e9), wall=1.0)))
    tell(4)
    assert "5 convex pieces" in messages[-1] and (
        surroundings_input.obstacles.accepted,
        surroundings_input.obstacles.refused,
    ) == (1, 1)
    inbox.now += 0.2 * free_space_of(controller.config).max_age
    assert "obstacles is" in surroundings_input.fault and "costmap" not in surroundings_input.fault
    tell(1)
    assert not surroundings_input.fault


def test_without_a_costmap_it_does_not_drive_and_with_one_it_stays_before_the_wall():
    with stack(SEEING, trajectory="s", drive=True, **{"parts.free_space.use_costmap": True}) as s:
        base, surroundings_input = s.base, s.node.parts["free_space"].surroundings
        assert not base.run(20).any()
        assert "the surroundings are" in s.loop.last.message
        publisher = s.publisher(OccupancyGrid, "costmap")

        def show(wall):
            count = surroundings_input.costmap.accepted
            publisher.publish(costmap(base.now, wall))
            base.until(lambda: surroundings_input.costmap.accepted > count, "the costmap to be read")

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
        assert "old" in surroundings_input.fault


def test_topics_of_surroundings_need_a_controller_that_sees():
    with pytest.raises(ValueError, match=r"set free_space\.enabled"), stack(**{"parts.free_space.use_costmap": True}):
        pass


def test_feature_that_only_parameters_name_is_attached():
    """ROS ignores a parameter that no node declares."""
    with stack(**{"expert.free_space.enabled": True, "expert.free_space.max_pieces": 4}) as s:
        group = free_space_of(s.node.parts["free_space"].require_tools().controller.config)
    assert group.enabled and group.max_pieces == 4
