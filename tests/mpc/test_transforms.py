"""Transforms: composition compared with matrices, chains, interpolation in time, and errors."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from diffdrive_mpc.mpc.ros.transforms import buffer as limits
from diffdrive_mpc.mpc.ros.transforms.buffer import TransformBuffer, TransformError
from diffdrive_mpc.mpc.ros.transforms.rigid import IDENTITY, Rigid

NOW = 100 * 10**9
NUMBERS = st.floats(-10.0, 10.0)
ANGLES = st.floats(-3.1, 3.1)


@st.composite
def rigids(draw):
    turn = Rotation.from_euler("zyx", [draw(ANGLES), draw(st.floats(-1.5, 1.5)), draw(ANGLES)])
    return Rigid(draw(NUMBERS), draw(NUMBERS), draw(NUMBERS), *turn.as_quat().tolist())


def matrix(rigid):
    result = np.eye(4)
    result[:3, :3] = Rotation.from_quat(rigid[3:]).as_matrix()
    result[:3, 3] = rigid[:3]
    return result


def planar(x, y, theta):
    return Rigid(x, y, 0.0, 0.0, 0.0, math.sin(0.5 * theta), math.cos(0.5 * theta))


@given(first=rigids(), second=rigids())
def test_composition_and_inverse_equal_those_of_matrices(first, second):
    np.testing.assert_allclose(matrix(second.after(first)), matrix(second) @ matrix(first), atol=1e-9)
    np.testing.assert_allclose(matrix(first.inverse()), np.linalg.inv(matrix(first)), atol=1e-9)


@given(first=rigids(), turn=st.floats(-3.0, 3.0), share=st.floats(0.0, 1.0))
def test_interpolation_between_two_attitudes_has_a_constant_rate(first, turn, share):
    axis = np.array([0.6, 0.0, 0.8])
    turn_rotation, partial_rotation = (
        Rigid(1.0, 2.0, 3.0, *Rotation.from_rotvec(angle * axis).as_quat().tolist()) for angle in (turn, share * turn)
    )
    start = first._replace(x=0.0, y=0.0, z=0.0)
    result = start.towards(start.after(turn_rotation), share)
    expected = Rotation.from_quat(start.after(partial_rotation)[3:])
    assert (Rotation.from_quat(result[3:]) * expected.inv()).magnitude() < 1e-6
    np.testing.assert_allclose(result[:3], share * np.array(start.after(turn_rotation)[:3]), atol=1e-9)


@given(
    transforms=st.lists(rigids(), min_size=5, max_size=5),
    ends=st.tuples(st.integers(0, 5), st.integers(0, 5)),
    parents=st.tuples(*(st.integers(0, index) for index in range(5))),
)
def test_transform_along_any_tree_is_the_product_of_matrices(transforms, ends, parents):
    """Frames 1 to 5 have an earlier frame as parent: products of matrices give each frame in frame 0."""
    buffer, world = TransformBuffer(), [np.eye(4)]
    for child, (parent, transform) in enumerate(zip(parents, transforms, strict=True), start=1):
        buffer.insert(f"f{parent}", f"f{child}", NOW, transform, NOW, static=child % 2 == 0)
        world.append(world[parent] @ matrix(transform))
    target, source = ends
    result = buffer.lookup(f"f{target}", f"f{source}", NOW)
    np.testing.assert_allclose(matrix(result.transform), np.linalg.inv(world[target]) @ world[source], atol=1e-8)


def moving_buffer(count=20):
    buffer = TransformBuffer()
    for index in range(count):
        stamp = NOW + index * 10**8
        buffer.insert("odom", "base_link", stamp, planar(0.1 * index, 0.0, 0.01 * index), stamp)
    return buffer


@given(elapsed=st.floats(0.0, 1.9))
def test_transform_between_two_stamps_is_interpolated(elapsed):
    result = moving_buffer().lookup("odom", "base_link", NOW, NOW + round(elapsed * 1e9))
    np.testing.assert_allclose(result.transform.planar, [elapsed, 0.0, 0.1 * elapsed], atol=1e-6)


def test_lookup_without_a_time_uses_the_newest_common_time_of_the_chain():
    """The localisation is slow at first; then its stamps are in the future."""
    buffer = moving_buffer()
    last = NOW + 1_900_000_000
    for stamp, x in ((NOW, 5.0), (NOW + 10**9, 6.0)):
        buffer.insert("map", "odom", stamp, planar(x, 0.0, 0.0), stamp)
    result = buffer.lookup("map", "base_link", last)
    assert (result.stamp, result.oldest) == (NOW + 10**9, "odom")
    assert result.transform.x == pytest.approx(7.0)
    buffer.insert("map", "odom", last + 10**9, planar(8.0, 0.0, 0.0), last)
    result = buffer.lookup("map", "base_link", last)
    assert (result.stamp, result.oldest) == (last, "base_link")
    assert result.transform.x == pytest.approx(6.0 + 0.9 / 1.9 * 2.0 + 1.9)


def test_static_transform_is_valid_at_any_time():
    buffer = moving_buffer()
    buffer.insert("base_link", "laser", 0, planar(0.2, 0.0, 0.0), NOW, static=True)
    assert buffer.lookup("base_link", "laser", NOW) == (planar(0.2, 0.0, 0.0), None, "")
    assert buffer.lookup("laser", "laser", NOW).transform == IDENTITY
    assert buffer.lookup("odom", "laser", NOW, NOW + 10**9).transform.x == pytest.approx(1.0 + 0.2 * math.cos(0.1))
    buffer.clear()
    assert buffer.lookup("base_link", "laser", NOW).transform.x == 0.2
    with pytest.raises(TransformError, match="there is no transform of 'odom'"):
        buffer.lookup("odom", "base_link", NOW)


@pytest.mark.parametrize(
    ("time", "message"),
    [(NOW + 2 * 10**9, "0.10 s after the last transform"), (NOW - 10**9, "1.00 s before the first transform")],
)
def test_lookup_outside_the_received_times_raises_error(time, message):
    with pytest.raises(TransformError, match=message):
        moving_buffer().lookup("odom", "base_link", NOW, time)


def test_error_for_unconnected_frames_contains_their_names():
    buffer = moving_buffer()
    buffer.insert("map", "robot2/odom", NOW, IDENTITY, NOW)
    with pytest.raises(TransformError, match="the frames are not connected"):
        buffer.lookup("map", "base_link", NOW)
    with pytest.raises(TransformError, match="there is no transform of 'mpa'"):
        buffer.lookup("mpa", "base_link", NOW)


def test_frame_loop_raises_error_with_its_frames():
    buffer = TransformBuffer()
    for parent, child in (("a", "b"), ("b", "c"), ("c", "a")):
        buffer.insert(parent, child, NOW, IDENTITY, NOW)
    with pytest.raises(TransformError, match="frames loop: c -> b -> a -> c"):
        buffer.lookup("odom", "c", NOW)


def test_alternating_parents_raise_error_but_a_single_change_does_not():
    buffer = moving_buffer()
    later = NOW + 2 * 10**9
    buffer.insert("map", "base_link", later, planar(1.0, 0.0, 0.0), later)
    assert buffer.lookup("map", "base_link", later).transform.x == 1.0
    buffer.insert("odom", "base_link", later + 1, planar(2.0, 0.0, 0.0), later + 1)
    with pytest.raises(TransformError, match="'base_link' has two alternating parents, 'odom' and 'map'"):
        buffer.lookup("odom", "base_link", later + 1)
    # The change of parents is forgotten after the storage time.
    last = later + limits.STORED_TIME + 2
    buffer.insert("odom", "base_link", last, planar(3.0, 0.0, 0.0), last)
    assert buffer.lookup("odom", "base_link", last).transform.x == 3.0


@pytest.mark.parametrize(
    ("transform", "stamp", "frames", "message"),
    [
        (planar(math.nan, 0.0, 0.0), NOW, ("odom", "base_link"), "not finite"),
        (Rigid(0, 0, 0, 0, 0, 0, 0), NOW, ("odom", "base_link"), "not a unit quaternion"),
        (IDENTITY, NOW + limits.MAX_FUTURE + 1, ("odom", "base_link"), "in the future: are the clocks in step"),
        (IDENTITY, NOW, ("odom", "odom"), "does not name two different frames"),
    ],
)
def test_unusable_transform_raises_error_without_effect(transform, stamp, frames, message):
    buffer = moving_buffer(count=1)
    with pytest.raises(TransformError, match=message):
        buffer.insert(*frames, stamp, transform, NOW)
    assert buffer.lookup("odom", "base_link", NOW) == (IDENTITY, NOW, "base_link")
    assert len(buffer) == 1


def test_memory_of_transforms_is_bounded():
    buffer = TransformBuffer()
    for index in range(limits.MAX_TRANSFORMS + 100):
        buffer.insert("odom", "base_link", NOW + index * 1000, IDENTITY, NOW)
    assert len(buffer) == limits.MAX_TRANSFORMS
    buffer.insert("odom", "base_link", NOW + 2 * limits.STORED_TIME, IDENTITY, NOW + 2 * limits.STORED_TIME)
    assert len(buffer) == 1
    with pytest.raises(TransformError, match="exceeds the maximum of"):
        for index in range(limits.MAX_FRAMES + 1):
            buffer.insert("odom", f"f{index}", NOW, IDENTITY, NOW)
    assert len(buffer) == limits.MAX_FRAMES
