"""Identification from commands and poses alone: mean twists over arcs, without a delay."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from diffdrive_mpc.models.identification.from_logs import identify
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.logs.draft_mapping import draft_mapping
from diffdrive_mpc.models.logs.pose_twist import with_twist_of_poses
from diffdrive_mpc.models.logs.record import Record

FINE = 0.002


def drive(twist, dt=FINE):
    """Return the poses (K, 3) of a body that moves with a twist (K, 2) from the origin."""
    heading = np.concatenate([[0.0], np.cumsum(twist[:-1, 1] * dt)])
    middle = heading + 0.5 * twist[:, 1] * dt
    steps = twist[:-1, :1] * dt * np.column_stack([np.cos(middle), np.sin(middle)])[:-1]
    return np.column_stack([np.vstack([[0.0, 0.0], np.cumsum(steps, axis=0)]), heading])


@given(v=st.floats(-2, 2), omega=st.floats(-2, 2), every=st.integers(1, 5))
def test_twist_of_an_arc_is_exact(v, omega, every):
    dt, count = 0.05, 60
    time = dt * np.arange(count)
    half = 0.5 * omega * time
    chord = v * time * np.sinc(half / np.pi)
    pose = np.column_stack([chord * np.cos(half), chord * np.sin(half), omega * time])
    fresh = np.arange(count) % every == 0
    (record,) = with_twist_of_poses([Record("arc", 0.0, dt, np.zeros((count, 2)), pose=pose, fresh_pose=fresh)])
    assert record.fresh_twist.sum() > 5
    assert record.twist[record.fresh_twist] == pytest.approx(
        np.tile([v, omega], (record.fresh_twist.sum(), 1)), abs=1e-9
    )


@pytest.mark.parametrize("stride", [1, 3])
def test_mean_twist_has_no_delay(stride):
    dt, count, substeps = 0.05, 1200, 25
    time = FINE * np.arange(count * substeps)
    pose = drive(np.column_stack([np.sin(time), 0.5 * np.cos(time)]))[::substeps]
    fresh = np.arange(count) % stride == 0
    (record,) = with_twist_of_poses([Record("sine", 0.0, dt, np.zeros((count, 2)), pose=pose, fresh_pose=fresh)])
    times = record.time[record.fresh_twist]
    error = record.twist[record.fresh_twist] - np.column_stack([np.sin(times), 0.5 * np.cos(times)])
    slope = np.column_stack([np.cos(times), -0.5 * np.sin(times)])
    delay = -np.sum(error * slope, axis=0) / np.sum(slope**2, axis=0)
    assert delay == pytest.approx(np.zeros(2), abs=0.002)


def write_log(folder, with_gyro=False, heading=True, y_sign=1):
    """Write 90 s of a robot with gains 0.9 and 0.8, delayed by 0.25 s and 0.3 s; return the log and its mapping."""
    stream, dt, count = np.random.default_rng(5), 0.05, 1800
    command = np.repeat(stream.uniform([-0.5, -0.8], [0.5, 0.8], (count // 30, 2)), 30, axis=0)
    ratio = round(dt / FINE)
    twist = np.empty((count * ratio, 2))
    for column, (gain, dead, lag) in enumerate([(0.9, 0.1, 0.15), (0.8, 0.1, 0.2)]):
        delayed = np.concatenate([np.zeros(round(dead / FINE)), np.repeat(command[:, column], ratio)])[: count * ratio]
        decay = np.exp(-FINE / lag)
        twist[:, column] = gain * signal.lfilter([1 - decay], [1.0, -decay], delayed)
    pose = drive(twist)[::ratio] + stream.normal(size=(count, 3)) * [0.003, 0.003, 0.004]
    gyro = twist[::ratio, 1] + 0.005 * stream.normal(size=count)
    table = np.column_stack([dt * np.arange(count), command, pose, *([gyro] if with_gyro else [])])
    np.savetxt(folder / "log.csv", table, "%.6f", ",", header="t,v,w,x,y,th" + ",g" * with_gyro, comments="")
    lines = ["source: drawn", "columns:", "  time: {column: t, unit: s}"]
    lines += ["  command: {v: {column: v, unit: m/s}, omega: {column: w, unit: rad/s}}"]
    theta = ", theta: {column: th, unit: rad}" if heading else ""
    lines += [f"  pose: {{x: {{column: x, unit: m}}, y: {{column: y, unit: m, sign: {y_sign}}}{theta}}}"]
    lines += ["  gyro: {yaw_rate: {column: g, unit: rad/s}}"] * with_gyro
    (folder / "mapping.yaml").write_text("\n".join(lines), encoding="utf-8")
    return folder / "log.csv", folder / "mapping.yaml"


@pytest.mark.parametrize(
    ("with_gyro", "heading", "gain_error", "delay_error"),
    [
        pytest.param(False, True, 0.02, 0.01, marks=pytest.mark.system),
        pytest.param(True, True, 0.02, 0.01, marks=pytest.mark.system),
        (False, False, 0.04, 0.02),
    ],
)
def test_commands_and_poses_alone_identify_a_robot(tmp_path, with_gyro, heading, gain_error, delay_error):
    log, mapping = write_log(tmp_path, with_gyro, heading)
    result = identify(log, mapping=mapping, structure="sm")
    assert not result.refusal
    for channel, gain, delay in [("v", 0.9, 0.25), ("omega", 0.8, 0.3)]:
        file = getattr(result.content.channels, channel)
        assert file.gain == pytest.approx(gain, rel=gain_error)
        identified_delay = getattr(result.content.dead_time, channel) + 2 * file.damping / file.natural_frequency
        assert identified_delay == pytest.approx(delay, abs=delay_error)
    assert "yaw rate of the wheels" not in result.report.markdown()
    message = "a controller needs a gyro or encoders"
    for text in (result.configuration.text(), result.report.markdown()):
        assert (message in text) == (not heading and not with_gyro)


@pytest.mark.parametrize("with_gyro", [False, True])
def test_heading_from_positions_is_true_heading(tmp_path, with_gyro):
    (expected,), (computed,) = (read_log(*write_log(tmp_path, with_gyro, heading)).records for heading in (True, False))
    error = np.angle(np.exp(1j * (computed.pose[:, 2] - expected.pose[:, 2])))
    assert np.sqrt(np.mean(error**2)) < 0.05


@pytest.mark.parametrize("with_gyro", [False, True])
def test_mirrored_positions_are_reported_once(tmp_path, with_gyro):
    errors = read_log(*write_log(tmp_path, with_gyro, heading=False, y_sign=-1)).errors
    assert [(error.kind, *map(str, error.changes)) for error in errors] == [("mirrored pose", "pose `y.sign: 1`")]


def test_draft_maps_positions_without_heading(tmp_path):
    log, _ = write_log(tmp_path)
    log.write_text(log.read_text(encoding="utf-8").replace("x,y,th", "pose_x,pose_y,spare"), encoding="utf-8")
    assert "theta" not in draft_mapping(log) and "pose_y" in draft_mapping(log)
