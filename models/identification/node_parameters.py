"""Parameters of the ROS node for the robot of a bag: what its topics are called, and which messages they carry."""

from __future__ import annotations

import shlex
from pathlib import Path

from diffdrive_mpc.models.logs.record import Topics

NODE_FILE = "node.yaml"
_NODE_NAMES = {"command": "cmd_vel", "odometry": "odom", "imu": "imu", "pose": "pose"}
_TYPES = {
    "command": ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"),
    "odometry": ("nav_msgs/msg/Odometry",),
    "imu": ("sensor_msgs/msg/Imu",),
    "pose": ("geometry_msgs/msg/PoseWithCovarianceStamped",),
}


def node_arguments(topics: Topics, folder: Path = Path()) -> str:
    """Return what follows `diffdrive-mpc node` for these topics, the parameters file being in `folder`."""
    words = ["--ros-args", "--params-file", str(folder / NODE_FILE)]
    for role, name in _NODE_NAMES.items():
        topic, kind = topics.get(role, (f"/{name}", ""))
        if kind in _TYPES[role] and topic != f"/{name}":
            words += ["-r", f"{name}:={topic}"]
    return shlex.join(words)


def node_text(topics: Topics) -> str:
    """Return the parameters file, with the topic beside each value; topics that the node cannot read are named.

    Topic names are remappings, which a parameters file cannot hold: the command that has them is its first line.
    """
    usable = {role: found for role, found in topics.items() if role in _TYPES and found[1] in _TYPES[role]}
    values = {
        "stamped": ("command", str("TwistStamped" in usable.get("command", ("", "TwistStamped"))[1]).lower()),
        "use_imu": ("imu", str("imu" in usable).lower()),
        "pose_source": ("pose", "topic" if "pose" in usable else "odometry"),
    }
    lines = [f"# diffdrive-mpc node --config config.yaml {node_arguments(topics)}", "/**:", "  ros__parameters:"]
    lines += [f"    {name}: {value}{_reason(topics, role)}" for name, (role, value) in values.items()]
    for role, (topic, kind) in topics.items():
        if role in _TYPES and role not in usable:
            expected = " or ".join(_TYPES[role])
            lines.append(f"    # {topic} carries {kind}, which the node cannot read as {role}: it takes {expected}")
    return "\n".join(lines) + "\n"


def _reason(topics: Topics, role: str) -> str:
    return "   # {} carries {}".format(*topics[role]) if role in topics else f"   # no {role} in the log"
