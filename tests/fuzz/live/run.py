"""`make fuzz FUZZ=live`: attack a live node for a while, and say what it did."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

# Before rclpy is imported: nobody else's robot.
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="ros-log-"))

import rclpy
from lifecycle_msgs.msg import Transition

from fuzz.live import tampering
from fuzz.live.attacker import Attacker, LostError, draw_action
from fuzz.live.doors import let_types_be_found
from fuzz.live.judge import SLACK, Account, Heard, faults, longest_gap
from fuzz.runner import environment

# Ticks and messages beside the stated times [s].
_TICKS = 0.1
# Memory may grow by this after the first campaigns of a life [MB].
_MOST_GROWTH = 60.0
LIVES: tuple[dict[str, object], ...] = (
    {"start_at_robot": True},
    {"start_at_robot": True, "pose_source": "tf", "use_sim_time": True},
    {
        "start_at_robot": True,
        "parts.free_space.use_costmap": True,
        "parts.free_space.use_obstacles": True,
        "free_space.enabled": True,
    },
    {"start_at_robot": True, "use_pose_topic": True, "drive_on_reference": True, "record": True},
    {"start_at_robot": False, "use_sim_time": True, "use_imu": False, "trajectory": "s"},
    {"start_at_robot": True, "use_tf": True},
    {"start_at_robot": True, "use_pose_topic": True, "use_sim_time": True},
)
"""Parameters of the nodes that are attacked, in turns."""
CAMPAIGNS_OF_A_LIFE = 10


@dataclass
class Result:
    """What a run did and found."""

    campaigns: int = 0
    actions: int = 0
    named_faults: int = 0
    lives: int = 0
    commands: int = 0
    gap: float = 0.0
    growth: float = 0.0
    found: list[str] = field(default_factory=list)
    done: dict[str, int] = field(default_factory=dict)


class Watcher:
    """The watcher's process and what it has written."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "watched"
        words = [sys.executable, "-m", "fuzz.live.watcher", str(self.file)]
        self.process = subprocess.Popen(words, stdin=subprocess.DEVNULL, env=environment())
        end = time.monotonic() + 60.0
        while not (self.file.exists() and self.file.read_text()):
            if time.monotonic() > end or self.process.poll() is not None:
                raise LostError("the watcher does not start")
            time.sleep(0.05)
        self._read = 0

    def into(self, account: Account) -> None:
        """Add what was heard since the last call."""
        time.sleep(0.3)
        with self.file.open() as file:
            file.seek(self._read)
            text = file.read()
        whole = text[: text.rfind("\n") + 1]
        self._read += len(whole.encode())
        for line in whole.splitlines():
            kind, at, *content = json.loads(line)
            if kind == "command":
                v, omega, number, others = content
                account.commands.append(Heard(at, v, omega, number, others))
            elif kind == "mode":
                account.modes.append((at, content[0]))

    def end(self) -> None:
        """End it."""
        self.process.terminate()
        self.process.wait()


def run(seconds: float, seed: int, folder: Path, first: int = 0, count: int | None = None) -> Result:
    """Attack for `seconds`, from campaign `first` on."""
    result = Result()
    missing = let_types_be_found()
    if missing:
        print(f"live: without transforms, speed limits and follow_path: {missing}")
    end = time.monotonic() + seconds
    rclpy.init(args=["--ros-args", "--log-level", "fatal"])
    watcher = Watcher(folder)
    number = first
    try:
        while time.monotonic() < end and len(result.found) < 10 and (count is None or number < first + count):
            number = _life(number, end, seed, folder, watcher, result, None if count is None else first + count)
    finally:
        watcher.end()
        rclpy.try_shutdown()
    return result


def _life(number: int, end: float, seed: int, folder: Path, watcher: Watcher, result: Result, last: int | None) -> int:
    """Campaigns on one node, until the last of its life, a fault or the end; returns the number of the next."""
    settings = LIVES[number // CAMPAIGNS_OF_A_LIFE % len(LIVES)]
    result.lives += 1
    watcher.into(Account())
    attacker = Attacker(folder, settings)
    used: list[tuple[float, int]] = []
    life_ends = (number // CAMPAIGNS_OF_A_LIFE + 1) * CAMPAIGNS_OF_A_LIFE
    try:
        while number < (life_ends if last is None else min(life_ends, last)) and time.monotonic() < end:
            said = f"campaign {number} of seed {seed}"
            random, done = Random(f"live/{seed}/{number}"), list[Any]()
            number += 1
            found: list[str] = []
            try:
                if not used:
                    # Later ones end with a good drive.
                    attacker.make_honest()
                    attacker.good_drive()
                (_named_fault if number % 2 else _storm)(attacker, random, done, result)
                attacker.make_honest()
                attacker.good_drive()
            except LostError as error:
                found.append(f"lost: {error}")
            result.campaigns += 1
            for status in attacker.doors.results:
                result.done[f"goal status {status}"] = result.done.get(f"goal status {status}", 0) + 1
            attacker.doors.results.clear()
            attacker._not_active()
            found += _judged(attacker, watcher, result)
            if not attacker.process.alive:
                found.append(f"died: with {attacker.process.process.returncode}")
            found += [f"log: {line}" for line in attacker.process.alarms()]
            used.append(attacker.process.used())
            if found:
                result.found += [f"{said}: {one}" for one in found[:4]]
                kept = folder / f"campaign-{seed}-{number - 1}.json"
                kept.write_text(json.dumps({"settings": settings, "done": done, "found": found}, indent=1))
                result.found[-1] += f"\n    {kept}, {attacker.process.log}"
                return number
        result.found += _grown(used, result)
        result.found += [f"end of life: {one}" for one in _ended(attacker, watcher, result)]
        return number
    finally:
        attacker.close()


def _judged(attacker: Attacker, watcher: Watcher, result: Result) -> list[str]:
    account = attacker.account
    account.stood, attacker.base.stood = attacker.base.stood, []
    watcher.into(account)
    result.commands += len(account.commands)
    result.gap = max(result.gap, longest_gap(account))
    found = faults(account)
    attacker.account = Account(commands=account.commands[-1:], modes=account.modes[-1:], allowed=account.allowed[-1:])
    attacker._active_since = None
    return found


def _grown(used: list[tuple[float, int]], result: Result) -> list[str]:
    """Memory and threads after the first campaigns, which load what is loaded once."""
    later = used[2:]
    if len(later) < 3:
        return []
    growth = later[-1][0] - later[0][0]
    result.growth = max(result.growth, growth)
    found = (
        [f"memory: it grew from {later[0][0]:.0f} to {later[-1][0]:.0f} MB in {len(later)} campaigns"]
        if growth > _MOST_GROWTH
        else []
    )
    if later[-1][1] > later[0][1]:
        found.append(f"threads: from {later[0][1]} to {later[-1][1]}")
    return found


def _storm(attacker: Attacker, random: Random, done: list[Any], result: Result) -> None:
    """Whatever comes, one upon the other."""
    for _ in range(random.choice((5, 10, 20))):
        action = draw_action(random)
        done.append(action)
        result.actions += 1
        result.done[action[0]] = result.done.get(action[0], 0) + 1
        attacker.act(action, random)
        attacker.spin(random.choice((0.0, 0.0, 0.02, 0.1, 0.4)))


def _named_fault(attacker: Attacker, random: Random, done: list[Any], result: Result) -> None:
    """One fault in a good drive, after which the command has to be zero within the time that is stated."""
    values = {name: value.double_value for name, value in attacker.known.items()}
    braking = max(
        values["limits.v"] / values["expert.limits.v_braking"],
        values["limits.omega"] / values["expert.limits.omega_braking"],
    )
    blind = values["odom_timeout"] + braking + _TICKS
    # Where poses come from elsewhere nobody looks at the orientation of odometry.
    by_odometry = not (attacker.settings.get("use_pose_topic") or "pose_source" in attacker.settings)
    blinding = [how for how in tampering.BLINDING if how != "no orientation" or by_odometry]
    choices: list[tuple[str, float]] = [(f"odom {how}", blind) for how in blinding]
    choices += [
        ("pause", braking + _TICKS),
        ("hold", braking + _TICKS),
        ("deactivate", _TICKS),
        ("carried 3 m", 1.0 + braking),
    ]
    if attacker.settings.get("use_pose_topic"):
        lost = values["failure.max_pose_age"] + braking + _TICKS
        choices += [(f"pose {how}", lost) for how in ("lost", "not a number", "other frame", "far ahead")]
    if attacker.settings.get("pose_source") == "tf":
        lost = values["failure.max_pose_age"] + braking + _TICKS
        choices += [(f"tf {how}", lost) for how in ("lost", "not a number", "no orientation")]
    if attacker.settings.get("parts.free_space.use_costmap"):
        # A robot that is told that it stands in something brakes at once.
        choices += [("costmap everywhere", 1.0 + braking), ("obstacles everywhere", 1.0 + braking)]
    if attacker.base.sim_time:
        choices += [("time backwards", braking + _TICKS)]
    name, within = random.choice(choices)
    done.append(["fault", name])
    result.named_faults += 1
    result.done[name] = result.done.get(name, 0) + 1
    attacker.spin(random.uniform(0.0, 1.0))
    at = time.monotonic()
    lasts = within + SLACK + 1.0
    _begin_fault(attacker, random, name)
    attacker.spin(max(0.0, at + lasts - time.monotonic()))
    # A service answers when the node has taken it; the time counts from then.
    attacker.account.zero.append((at + within + SLACK + max(0.0, _asking(attacker, at)), time.monotonic() - 0.05, name))


def _asking(attacker: Attacker, at: float) -> float:
    """How long a request took, of those that began at `at` [s]."""
    return max((told - at for told in attacker.account.told if told >= at), default=0.0)


def _begin_fault(attacker: Attacker, random: Random, name: str) -> None:
    topic, _, how = name.partition(" ")
    if topic in ("odom", "pose"):
        attacker.base.tamper[topic] = tampering.make(how, random)
    elif topic in ("costmap", "obstacles"):
        attacker.do_around(random, topic, how)
    elif topic == "tf":
        attacker.do_tf(random, how)
    elif name == "pause":
        attacker.trigger("pause")
    elif name == "hold":
        attacker.hold(True)
    elif name == "deactivate":
        attacker.transition(Transition.TRANSITION_DEACTIVATE)
    elif name == "carried 3 m":
        attacker.do_carry(random, 3.0, 3.0, 0.0)
    elif name == "time backwards":
        attacker.do_clock(random, -5.0, False)


def _ended(attacker: Attacker, watcher: Watcher, result: Result) -> list[str]:
    """A signal in a good drive: zero is its last command, and it leaves with 0."""
    try:
        attacker.make_honest()
        attacker.good_drive()
    except LostError as error:
        return [f"lost: {error}"]
    attacker._not_active()
    number = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)[result.lives % 3]
    at = time.monotonic()
    code = attacker.process.end(number)
    attacker.account.told += [at + 0.1 * i for i in range(int(10 * (time.monotonic() - at)) + 2)]
    attacker.spin(0.2)
    watcher.into(attacker.account)
    last = attacker.account.commands[-1]
    found = [] if (last.v, last.omega) == (0.0, 0.0) else [f"{number.name}: its last command is {last}"]
    if code != 0:
        found.append(f"{number.name}: it ended with {code}")
    result.done[number.name] = result.done.get(number.name, 0) + 1
    return found + faults(attacker.account) + [f"log: {line}" for line in attacker.process.alarms()]


def main(seconds: float, seed: int, folder: Path | None, first: int | None) -> int:
    """Run and say what was done; returns how much was found."""
    folder = folder or Path(tempfile.mkdtemp(prefix="fuzz-live-"))
    folder.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    result = run(seconds, seed, folder, first or 0, None if first is None else 1)
    said = ", ".join(f"{name} {count}" for name, count in sorted(result.done.items()))
    cpu = resource.getrusage(resource.RUSAGE_CHILDREN)
    took = time.monotonic() - started
    print(
        f"live         seed {seed}: {result.campaigns} campaigns on {result.lives} nodes in {took:.0f} s, "
        f"{result.actions} actions and {result.named_faults} named faults, {result.commands} commands; "
        f"longest time without one while active {result.gap:.2f} s; memory grew by {result.growth:.1f} MB; "
        f"{cpu.ru_utime + cpu.ru_stime:.0f} s of processor time; {len(result.found)} findings\n    {said}"
    )
    for line in result.found:
        print(f"  - {line}")
    if result.found:
        print(f'    make fuzz FUZZ="live --seed {seed} --only NUMBER" repeats one as far as DDS can; kept in {folder}')
    return len(result.found)
