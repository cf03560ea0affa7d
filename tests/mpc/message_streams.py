"""Streams of numbered messages from two simultaneous publishers, or from a publisher that is restarted repeatedly."""

from typing import NamedTuple

import numpy as np

RESERVED = 7_000_000
"""First of the seeds that were not used to choose a threshold."""
BOUND = 0.3
"""Time within which a second publisher is detected, unless its third message arrives later [s]."""


class Message(NamedTuple):
    arrival: float
    number: int | None
    sent: int


class Driver:
    """A publisher of 10 to 200 Hz with clock offset, latency, losses and reordering."""

    def __init__(self, draw, *, clock_offset=0.0):
        self.draw, self.offset = draw, clock_offset
        self.period = 1.0 / draw.choice([10.0, 20.0, 50.0, 100.0, 200.0, draw.uniform(10.0, 200.0)])
        self.burst = int(draw.choice([1, 1, 1, 2, 5])) if self.period < 0.04 else 1
        self.jitter = self.period * draw.choice([0.0, 0.05, 0.3])
        self.loss = draw.choice([0.0, 0.0, 0.01, 0.1])
        self.network = draw.choice([1e-4, 1e-4, 2e-3, 0.01])
        self.overtaken = draw.choice([0.0, 0.0, 0.01, 0.05])

    def messages(self, start, end, first=1):
        """Return the messages between two times [s], numbered from `first`, in the order of arrival."""
        draw, count = self.draw, int((end - start) / self.period)
        sent = start + self.period * np.arange(0, count, self.burst)
        sent = np.repeat(sent + draw.uniform(0.0, self.jitter, len(sent)), self.burst)[:count]
        sent += 2e-4 * (np.arange(count) % self.burst)
        arrivals = np.maximum.accumulate(sent + 1e-4 + draw.exponential(self.network, count)) + 1e-6 * np.arange(count)
        order = np.argsort(np.arange(count) + 2.1 * (draw.random(count) < self.overtaken))
        return [
            Message(float(arrival), first + int(k), int(1e9 * (1e5 + sent[k] + self.offset)))
            for arrival, k in zip(arrivals, order, strict=True)
            if draw.random() >= self.loss
        ]


def without_numbers(messages, kind):
    """Return the messages as a middleware without sequence numbers delivers them."""
    return [message._replace(number={"none": None, "zero": 0, "constant": 9}[kind]) for message in messages]


def twins(seed):
    """Return the messages of a driver and of a second driver, which starts 2 to 4 s later."""
    draw = np.random.default_rng(seed)
    offset = 0.0 if draw.random() < 0.5 else draw.choice([-1.0, 1.0]) * 10.0 ** draw.uniform(-3.0, 3.0)
    first, second = Driver(draw), Driver(draw, clock_offset=offset)
    start = 2.0 + draw.uniform(0.0, 2.0)
    # The second driver numbers from 1, from nearly the number of the first driver, or from a random number.
    number = int(draw.choice([1, start / first.period + draw.integers(-5, 6), draw.integers(1, 100_000)]))
    return first.messages(0.0, 8.0), second.messages(start, 8.0, max(1, number))


def restarts(seed, count=50, *, is_ordered=False, min_life=0.15):
    """Return the messages of a driver that is killed and restarted `count` times; its stamps continue."""
    draw = np.random.default_rng(seed)
    messages, start = [], 0.0
    driver = Driver(draw)
    driver.overtaken *= not is_ordered
    mean_duration = 10.0 ** draw.uniform(-0.5, 0.7)
    for _ in range(count + 1):
        end = start + max(min_life, mean_duration * draw.uniform(0.5, 1.5))
        driver.loss = draw.choice([0.0, 0.01, 0.1])
        # The reader misses messages that are sent before discovery.
        messages += driver.messages(start, end, first=1 + int(draw.choice([0, 0, 5, 40])))
        start = end + draw.uniform(0.1, 2.0)
    return messages


def delay_of(detect, seed):
    """Return the time from the bound to the detection [s], negative within the bound; infinite without detection.

    `detect` returns the time at which it detects a second publisher in a stream of messages, or None.
    """
    first, second = twins(seed)
    second.sort()
    time = detect(first + second)
    return np.inf if time is None else time - max(second[0].arrival + BOUND, second[2].arrival)
