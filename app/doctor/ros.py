"""ROS 2: is it there, which middleware, and does it find others."""

from __future__ import annotations

import importlib.util
import socket
from contextlib import suppress

from diffdrive_mpc.app.doctor.machine import Machine, MachineFinding, doctor_settings, in_bytes

_GROUP, _FIRST_PORT, _PORTS_A_DOMAIN, _LAST_DOMAIN = "239.255.0.1", 7400, 250, 101
"""DDS-RTPS, 9.6.1.1: where they announce themselves. Beyond the last domain Linux hands the ports out itself."""
_PATIENCE = 0.5  # s


def ros(machine: Machine) -> MachineFinding:
    """Which ROS."""
    sourced, wheels = machine.variable("ROS_DISTRO"), machine.installed("ros-jazzy-rclpy")
    if sourced and wheels:
        means = "which rclpy is found is left to chance: use an environment without the extra ros"
        return MachineFinding(
            "ROS 2", "warn", f"{sourced} is sourced, and rclpy {wheels} is installed as a wheel", means
        )
    if wheels:
        return MachineFinding(
            "ROS 2",
            "ok",
            f"Jazzy, rclpy {wheels} as wheels",
            "node and simulated robot; not `ros2`, launch files and RViz",
        )
    if sourced and _importable("rclpy"):
        means = "node and simulated robot" if sourced == "jazzy" else "tried with Jazzy only"
        return MachineFinding("ROS 2", "ok" if sourced == "jazzy" else "warn", f"{sourced} is sourced", means)
    if sourced:
        means = "this Python does not see rclpy: python3 -m venv --system-site-packages, with ROS's own Python"
        return MachineFinding("ROS 2", "warn", f"{sourced} is sourced", means)
    return MachineFinding(
        "ROS 2",
        "missing",
        "none",
        "needed for `node` and `sim-robot` only: source the setup file, or pip install 'diffdrive-mpc[ros]'",
    )


def _importable(name: str) -> bool:
    with suppress(ImportError, ValueError):
        return importlib.util.find_spec(name) is not None
    return False


def middleware(machine: Machine) -> MachineFinding:
    """Which DDS, and which settings of it."""
    chosen = machine.variable("RMW_IMPLEMENTATION") or "the default (rmw_fastrtps_cpp)"
    names = (
        "ROS_AUTOMATIC_DISCOVERY_RANGE",
        "ROS_LOCALHOST_ONLY",
        "ROS_STATIC_PEERS",
        "CYCLONEDDS_URI",
        "FASTRTPS_DEFAULT_PROFILES_FILE",
    )
    more = [f"{name}={machine.variable(name)}" for name in names if machine.variable(name)]
    means = "the same on all computers of the robot"
    return MachineFinding("middleware", "ok", ", ".join([chosen, *more]), means)


def domain(machine: Machine) -> MachineFinding:
    """Which domain, and whether its port is to be had."""
    text = machine.variable("ROS_DOMAIN_ID") or "0"
    if not text.isdigit() or int(text) > _LAST_DOMAIN:
        return MachineFinding("domain", "warn", f"ROS_DOMAIN_ID={text}", f"give a number from 0 to {_LAST_DOMAIN}")
    port = _FIRST_PORT + _PORTS_A_DOMAIN * int(text)
    means = "the same on all computers of the robot, another one for other robots on the network"
    return MachineFinding("domain", "ok", f"{text}, UDP ports from {port} on", means)


def multicast(machine: Machine) -> MachineFinding:
    """Whether an announcement comes back on this computer."""
    text = machine.variable("ROS_DOMAIN_ID") or "0"
    port = _FIRST_PORT + _PORTS_A_DOMAIN * (int(text) if text.isdigit() and int(text) <= _LAST_DOMAIN else 0)
    try:
        heard = _hears_itself(port + _PORTS_A_DOMAIN - 1)
    except OSError as error:
        heard, reason = False, f" ({error.strerror or error})"
    else:
        reason = ""
    if heard:
        return MachineFinding("multicast", "ok", "heard on loopback", "nodes on this computer find each other")
    means = "nodes may not find each other: allow multicast (sudo ip link set lo multicast on), or set ROS_STATIC_PEERS"
    return MachineFinding("multicast", "warn", f"not heard on loopback{reason}", means)


def _hears_itself(port: int) -> bool:
    """Send to the group on loopback, on a port of the domain that no participant has."""
    member = socket.inet_aton(_GROUP) + socket.inet_aton("127.0.0.1")
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mouth,
    ):
        ear.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        ear.bind(("", port))
        ear.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        ear.settimeout(_PATIENCE)
        mouth.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        mouth.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
        mouth.sendto(b"diffdrive-mpc doctor", (_GROUP, port))
        try:
            return ear.recv(64) == b"diffdrive-mpc doctor"
        except TimeoutError:
            return False


def shared_memory(machine: Machine) -> MachineFinding:
    """Room for messages between processes of one computer."""
    free = machine.free("dev/shm")
    if free is None:
        return MachineFinding("shared memory", "unknown", "no /dev/shm", "messages go by UDP")
    if free < doctor_settings().least_shared_memory:
        means = "Fast DDS may fail or fall back to UDP: start the container with --shm-size=512m or --ipc=host"
        return MachineFinding("shared memory", "warn", f"{in_bytes(free)} free", means)
    return MachineFinding(
        "shared memory", "ok", f"{in_bytes(free)} free", "messages between processes go the quick way"
    )
