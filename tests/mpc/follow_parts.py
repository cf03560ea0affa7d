"""Helpers for tests of follow_path: the node and its base in lock step, and an independent client process."""

import json
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from ros_parts import DT, PATIENCE, stack

SUCCEEDED, CANCELED, ABORTED = 4, 5, 6


class Client:
    """Client process; `events` contains its messages."""

    def __init__(self):
        self.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("follow_client.py"))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.events = []
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self):
        for line in self.process.stdout:
            self.events.append(json.loads(line))

    def write(self, **fields):
        self.process.stdin.write(json.dumps(fields) + "\n")
        self.process.stdin.flush()

    def send(self, name, poses, **options):
        self.write(send=name, poses=np.asarray(poses, dtype=float).tolist(), **options)

    def burst(self, name, goals, times, rate):
        """Send these goals, with `poses` and the options of `send`, in turn at `rate` [Hz]; return their names."""
        goals = [goal | {"poses": np.asarray(goal["poses"], dtype=float).tolist()} for goal in goals]
        self.write(burst=name, goals=goals, times=times, rate=rate)
        return [f"{name} {number}" for number in range(times)]

    def events_for(self, name, event):
        return [entry for entry in list(self.events) if entry.get("id") == name and entry["event"] == event]

    def result(self, name):
        return next(iter(self.events_for(name, "result")), None)

    def close(self):
        self.process.stdin.close()
        self.process.wait(PATIENCE)
        self.process.stdout.close()


class Follow:
    """Node, base and client; ticks run in approximately real time."""

    def __init__(self, made, client):
        self.made, self.base, self.client = made, made.base, client

    def tick(self, count=1, pace=DT):
        for _ in range(count):
            start = time.monotonic()
            self.base.step()
            while time.monotonic() - start < pace:
                self.base.spin()

    def until(self, condition, awaited, pace=0.5 * DT, max_ticks=4000):
        for _ in range(max_ticks):
            if condition():
                return
            self.tick(pace=pace)
        raise AssertionError(f"timed out waiting for {awaited}; {self.client.events[-3:]}")

    def wait_for_motion(self, name="a"):
        """Wait until the robot moves for a goal."""
        self.until(
            lambda: self.client.events_for(name, "feedback") and abs(self.base.commands[-1][0]) > 0.2,
            "the robot drives",
        )

    def wait_for_end(self, name, **options):
        self.until(lambda: self.client.result(name) is not None, f"the end of {name}", **options)
        return self.client.result(name)


@contextmanager
def following(overrides=None, **parameters):
    with stack(overrides, **parameters) as made:
        client = Client()
        try:
            follow = Follow(made, client)
            follow.until(lambda: any(event["event"] == "ready" for event in client.events), "the client", pace=DT)
            yield follow
        finally:
            client.close()
