"""Logs whose stamps are wrong, whose streams are shifted, or that change in the middle or from one to the next."""

import numpy as np
from degraded_bases import robot
from degraded_changes import (
    SHIFT,
    Case,
    from_the_middle,
    in_bursts,
    replaced,
    rows,
    scaled,
    shifted,
    shuffled_stamps,
    without_some_seconds,
)


def all_shifts(base, streams=("command", "encoders", "gyro", "pose")):
    return [
        Case(
            base,
            f"{stream} {seconds:+.1f} s",
            shifted(stream, seconds),
            SHIFT,
            (stream, "delay"),
            None if stream in ("encoders", "gyro", "pose") else seconds > 0,
        )
        for stream in streams
        for seconds in (0.3, -0.3)
    ]


TIMES = (
    *all_shifts("simulated"),
    *[case for case in all_shifts("husky") if case.name not in ("husky: gyro +0.3 s", "husky: command +0.3 s")],
    *all_shifts("asphalt", ("command", "gyro")),
    Case(
        "simulated",
        "two robots",
        lambda columns, base: [columns, robot(seed=21, gain=(0.6, 1.3), lag=0.3)],
        ("different logs",),
        ("v",),
        None,
    ),
    Case(
        "husky",
        "two robots",
        lambda columns, base: [columns, scaled(encoders=0.6)(columns, base)],
        ("different logs",),
        ("v",),
        None,
    ),
    Case(
        "simulated",
        "encoders half from the middle on",
        from_the_middle("encoders", 0.5),
        ("scale change",),
        ("encoders",),
        True,
    ),
    Case("husky", "gyro twice from the middle on", from_the_middle("gyro", 2.0), ("scale change",), ("gyro",), True),
    Case(
        "husky",
        "encoders 1.6 times from the middle on",
        from_the_middle("encoders", 1.6),
        ("scale change",),
        ("encoders",),
        True,
    ),
    Case("husky", "stamps shuffled", replaced(t=shuffled_stamps), ("shuffled stamps",), ("sample_time",), True),
    Case("simulated", "stamps in bursts", replaced(t=in_bursts), ("bursty stamps",), ("sample_time: 0.02",), None),
    Case(
        "husky",
        "whole seconds as stamps",
        replaced(t=lambda c: np.floor(c["t"])),
        ("bursty stamps",),
        ("sample_time: 0.05",),
        None,
    ),
    Case(
        "simulated",
        "another clock from the middle on",
        replaced(t=lambda c: c["t"] + np.where(np.arange(len(c["t"])) < 3000, 0.0, 1.7e9)),
        ("two clocks",),
        ("clock",),
    ),
    Case("simulated", "gaps", rows(without_some_seconds), ("gap",), ("no data",)),
)
