"""Comparison of the product's controller with the oracle, tick by tick, for the same measurements."""

from __future__ import annotations

import re
from functools import cache
from unittest.mock import patch

import numpy as np
import pytest

from diffdrive_mpc import Controller, Measurement, load_config
from diffdrive_mpc.mpc.core import library
from diffdrive_mpc.mpc.core.sources import CORE, declarations
from diffdrive_mpc.mpc.estimate import SENSORS
from oracle.controller import OracleController

EXACT = 1e-9
"""Rounding error between two exact evaluations of the same formulas [m/s, rad/s, m, rad]."""

# A solver whose results equal those of the oracle up to rounding.
# The oracle has no monitor; test_monitor.py checks that a monitor without findings changes no command.
ACTIVE_SET = {"solver.tolerance": 1e-9, "monitor.enabled": False}


def assert_same(result, expected, accuracy=EXACT):
    """Compare two step results; `accuracy` is that of the solver and does not affect the estimate."""
    # Messages of the oracle do not name limits and references that end before the first step.
    message = re.sub("; at [^;]+|(^|; )the reference ended [^;]+", "", result.message)
    assert (result.mode, message, result.solver.status) == (expected.mode, expected.message, expected.solver.status)
    assert_close(result.command, expected.command, accuracy)
    for name in ("plan", "planned_commands", "reference"):
        value, expected_value = getattr(result, name), getattr(expected, name)
        assert (value is None) == (expected_value is None), name
        if expected_value is not None:
            assert_close(value, expected_value, accuracy, name)
    for name in ("progress", "reference_delay", "blocked_for"):
        assert getattr(result, name) == pytest.approx(getattr(expected, name), abs=accuracy), name
    assert (result.estimate is None) == (expected.estimate is None)
    if expected.estimate is not None:
        assert_close(estimate_values(result.estimate), estimate_values(expected.estimate))


def assert_close(value, expected, accuracy=EXACT, name=""):
    """Compare arrays within the larger of `accuracy` and rounding; much faster than pytest's approx."""
    value, expected = np.asarray(value), np.asarray(expected)
    assert value.shape == expected.shape, name
    # The negation rejects NaN.
    is_wrong = ~(np.abs(value - expected) <= np.maximum(accuracy, EXACT * np.abs(expected)))
    assert not is_wrong.any(), (name, value[is_wrong], expected[is_wrong])


def estimate_values(estimate):
    """Return all values of an estimate in one row; -1 for a missing innovation."""
    innovations = [estimate.innovations.get(sensor, -1.0) for sensor in SENSORS]
    parts = (estimate.mean, estimate.deviation, estimate.twist, estimate.twist_deviation, innovations)
    return np.concatenate([[estimate.time, estimate.pose_age], *parts])


class Pair:
    """Product and oracle with the methods of the product; `results` contains the results of the product."""

    def __init__(self, config, model=None, accuracy=EXACT):
        self.controllers = (Controller(config, model), OracleController(config, model))
        self.accuracy, self.results = accuracy, []

    def start(self, reference, t0):
        for controller in self.controllers:
            controller.start(reference, t0)

    def reset(self):
        for controller in self.controllers:
            controller.reset()

    def resume(self):
        for controller in self.controllers:
            controller.resume()

    def update(self, **changes):
        product, oracle = (controller.update(**changes) for controller in self.controllers)
        assert product == oracle

    def override(self, commands):
        for controller in self.controllers:
            controller.set_applied_commands(commands)

    def step(self, t, measurement, hold=None):
        result, expected = (controller.step(t, measurement, hold) for controller in self.controllers)
        assert_same(result, expected, self.accuracy)
        self.results.append(result)
        return result

    def drive(self, plant, reference, ticks, event=None):
        """Drive `plant` with the product's commands, from the start of `reference`.

        `event(k, t, measurement, pair)` may change the inputs: it returns time, measurement and hold.
        """
        plant.reset(reference.sample([0.0]).pose[0])
        self.start(reference, plant.time)
        for k in range(ticks):
            t, measurement, hold = plant.time, plant.measure(), None
            if event is not None:
                t, measurement, hold = event(k, t, measurement, self)
            plant.advance(self.step(t, measurement, hold).command)
        return self.results

    @property
    def modes(self):
        """Modes in order, without repetitions."""
        sequence = [str(result.mode) for result in self.results]
        return [mode for k, mode in enumerate(sequence) if k == 0 or mode != sequence[k - 1]]

    @property
    def messages(self):
        """All messages, without repetitions."""
        return " / ".join(sorted({result.message for result in self.results}))


def replace_parts(m, **parts):
    """Return the measurement with some of its parts replaced."""
    fields = ("pose", "wheel_twist", "yaw_rate", "wheel_speeds", "sent")
    return Measurement(**{name: parts.get(name, getattr(m, name)) for name in fields})


@cache
def inner_core():
    """Return cffi's declarations and the library that the product loads."""
    text = "\n".join((CORE / name).read_text(encoding="utf-8") for name in ("core.h", "active_set.h", "internal.h"))
    with patch.object(library, "core_declarations", lambda: declarations(text)):
        return library.load_core.__wrapped__()


class InnerController:
    """Controller with access to its `ddmpc_controller` as `c` and to its mutable constants as `k`."""

    def __init__(self, name="ssm", **changes):
        self.ffi, self.lib = inner_core()
        self.controller = Controller(load_config(name, changes))
        tick = self.controller._tick
        self.c = self.ffi.cast("ddmpc_controller *", int(tick.ffi.cast("uintptr_t", tick.c)))
        assert self.ffi.sizeof("ddmpc_controller") == self.lib.ddmpc_controller_bytes()
        self.k = self.ffi.cast("ddmpc_constants *", self.c.constants)
