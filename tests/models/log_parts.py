"""Short drive with known results, and writers of log files with the formats of real robots."""

import csv
from dataclasses import replace

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from diffdrive_mpc.models.pose import integrate_pose

DT = 0.02
MAPPING = """
columns:
  time: t
  command: {v: v_ref, omega: omega_ref}
  encoders: {v: v, omega: omega_wheels}
  gyro: {yaw_rate: gyro}
  pose: {x: x, y: y, theta: theta}
"""
STORE = get_typestore(Stores.ROS2_JAZZY)
BAG_START = 1_700_000_000


def drive(seconds=20.0, dt=DT, seed=0):
    """Simulate columns of a robot (lags 0.1 s) under random steps of half a second, with noise on every sensor."""
    rng = np.random.default_rng(seed)
    count = round(seconds / dt)
    steps = rng.uniform([-1.0, -1.5], [1.0, 1.5], (count, 2))[:: round(0.5 / dt)]
    command = np.repeat(steps, round(0.5 / dt), axis=0)[:count]
    twist, pose = np.zeros((count, 2)), np.zeros((count, 3))
    for k in range(1, count):
        twist[k] = twist[k - 1] + (1 - np.exp(-dt / 0.1)) * (command[k - 1] - twist[k - 1])
        pose[k] = integrate_pose(pose[k - 1], *(0.5 * (twist[k] + twist[k - 1])), dt)
    noisy = twist + rng.normal(0, 0.005, twist.shape)
    columns = {"t": dt * np.arange(count), "v_ref": command[:, 0], "omega_ref": command[:, 1]}
    columns |= {"v": noisy[:, 0], "omega_wheels": 1.6 * noisy[:, 1]}
    columns |= {"gyro": twist[:, 1] + rng.normal(0, 0.005, count)}
    return columns | dict(zip(("x", "y", "theta"), (pose + rng.normal(0, 0.001, pose.shape)).T, strict=True))


def write_csv(path, columns):
    """Write a table without loss of precision."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow([cell if isinstance(cell, str) else repr(float(cell)) for cell in row])
    return path


def write_mapping(path, text=MAPPING):
    path.write_text(text)
    return path


def message(message_type, reading, seconds):
    """Build a message of `message_type`, with the stamp `seconds` [s] if it has a header."""
    types, type_name = STORE.types, message_type.split("/")[-1]

    def vector(x=0.0, y=0.0, z=0.0):
        return types["geometry_msgs/msg/Vector3"](x, y, z)

    def twist(v, omega):
        return types["geometry_msgs/msg/Twist"](vector(x=v), vector(z=omega))

    def pose(x, y, theta):
        point = types["geometry_msgs/msg/Point"](x, y, 0.0)
        return types["geometry_msgs/msg/Pose"](point, quaternion(theta))

    def quaternion(theta):
        return types["geometry_msgs/msg/Quaternion"](0.0, 0.0, np.sin(theta / 2), np.cos(theta / 2))

    def transform_message(parent, child, roll):
        turn = types["geometry_msgs/msg/Quaternion"](np.sin(roll / 2), 0.0, 0.0, np.cos(roll / 2))
        transform = types["geometry_msgs/msg/Transform"](vector(), turn)
        return types["geometry_msgs/msg/TransformStamped"](replace(header, frame_id=parent), child, transform)

    def with_covariance(name, value):
        return types[f"geometry_msgs/msg/{name}WithCovariance"](value, np.zeros(36))

    nanoseconds = round(seconds * 1e9)
    stamp = types["builtin_interfaces/msg/Time"](nanoseconds // 10**9, nanoseconds % 10**9)
    header = types["std_msgs/msg/Header"](stamp, "base_link")
    bodies = {
        "Twist": lambda: [vector(x=reading[0]), vector(z=reading[1])],
        "TwistStamped": lambda: [header, twist(*reading)],
        "Odometry": lambda: [
            header,
            "base_link",
            with_covariance("Pose", pose(9.0, 9.0, 0.0)),
            with_covariance("Twist", twist(*reading)),
        ],
        "Imu": lambda: [
            *(header, quaternion(0.0), np.zeros(9), vector(**dict(zip("zxy", reading, strict=False))), np.zeros(9)),
            *(vector(), np.zeros(9)),
        ],
        "TFMessage": lambda: [[transform_message(*reading)]],
        "PoseStamped": lambda: [header, pose(*reading)],
        "PoseWithCovarianceStamped": lambda: [header, with_covariance("Pose", pose(*reading))],
        "String": lambda: ["hello"],
        "Float32": lambda: [float(reading[0])],
        "BatteryState": lambda: [
            header,
            *(float(reading[0]), float("nan"), float(reading[1]), *[float("nan")] * 4),
            *(2, 0, 0, True, np.empty(0, np.float32), np.empty(0, np.float32), "", ""),
        ],
        "JointState": lambda: [header, ["fl", "fr", "rl", "rr"], np.empty(0), np.zeros(4), np.array(reading, float)],
    }
    return types[message_type](*bodies[type_name]())


def write_bag(folder, topics, storage="sqlite3"):
    """Write a bag from topics: (type, times of receipt [s], stamps [s], readings) by name.

    A name with `#` and a text adds a second type to the topic.
    """
    plugin = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}[storage]
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        queue = []
        for name, (message_type, received, stamped, readings) in topics.items():
            connection = writer.add_connection(name.partition("#")[0], message_type, typestore=STORE)
            for instant, stamp, reading in zip(received, stamped, readings, strict=True):
                queue.append((round((BAG_START + instant) * 1e9), connection, message_type, reading, BAG_START + stamp))
        for instant, connection, message_type, reading, stamp in sorted(queue, key=lambda item: item[0]):
            writer.write(connection, instant, STORE.serialize_cdr(message(message_type, reading, stamp), message_type))
    return folder


def bag_topics(columns, command="geometry_msgs/msg/Twist", pose="geometry_msgs/msg/PoseStamped"):
    """Return the topics of a robot with the motion in `columns`; odometry, gyro and poses arrive with a delay."""
    t = columns["t"] + 1.0

    def rows(*names):
        return np.column_stack([columns[name] for name in names])

    return {
        "/cmd_vel": (command, t, t, rows("v_ref", "omega_ref")),
        "/odom": ("nav_msgs/msg/Odometry", t + 0.004, t, rows("v", "omega_wheels")),
        "/imu": ("sensor_msgs/msg/Imu", t + 0.007, t, rows("gyro")),
        "/pose": (pose, t[::5] + 0.05, t[::5], rows("x", "y", "theta")[::5]),
    }


TEXTS = ("mode", "solver_status", "solver_path", "message")


def read_columns(path):
    """Read the columns of a log of `simulate` unchanged: numbers (NaN in empty cells), and lists of texts."""
    with path.open(encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    columns = dict(zip(header, zip(*rows, strict=True), strict=True))
    return {
        name: list(cells) if name in TEXTS else np.array([float(cell or "nan") for cell in cells])
        for name, cells in columns.items()
    }


def teleoperated(seconds=60.0, rate=100.0, sensor_dt=1 / 30, seed=0):
    """Simulate topics of a robot (lags 0.1 s) with commands at `rate` [Hz] only while a key is pressed.

    Between key presses the last command remains active, as on a base without a timeout.
    """
    rng = np.random.default_rng(seed)
    fine = 0.01
    time = fine * np.arange(round(seconds / fine))
    presses = np.arange(0.5, seconds - 2.0, 1.6)
    levels = rng.uniform([-0.3, -1.0], [0.3, 1.0], (len(presses), 2))
    levels[1::3] = 0.0
    lengths = rng.uniform(0.3, 0.9, len(presses))
    send_times = [times + np.arange(0.0, length, 1 / rate) for times, length in zip(presses, lengths, strict=True)]
    commands = np.repeat(levels, [len(part) for part in send_times], axis=0)
    send_times = np.concatenate(send_times) + rng.uniform(0.0, 0.001, len(commands))
    count = np.searchsorted(send_times, time, side="right")
    active_commands = np.where(count[:, None] > 0, commands[count - 1], 0.0)
    twist = np.zeros_like(active_commands)
    for k in range(1, len(time)):
        twist[k] = twist[k - 1] + (1 - np.exp(-fine / 0.1)) * (active_commands[k - 1] - twist[k - 1])
    times = np.arange(0.0, seconds - 0.1, sensor_dt)
    odometry = np.column_stack([np.interp(times, time, column) for column in twist.T])
    odometry += rng.normal(0, 0.003, odometry.shape)
    return {
        "/cmd_vel": ("geometry_msgs/msg/Twist", send_times, send_times, commands),
        "/odom": ("nav_msgs/msg/Odometry", times + 0.002, times, odometry),
    }
