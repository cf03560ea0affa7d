"""The sensor test in C against its oracle: drawn motions, faults and thresholds, and all that both remember.

The functions of `mpc/core/internal.h` are called directly. Evidence is nowhere kept: thresholds are moved to either
side of the oracle's, and C has to decide likewise.
"""

from __future__ import annotations

import copy
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from side_by_side import InnerController

from diffdrive_mpc.mpc.core.sources import CORE
from oracle.commands import PastCommands
from oracle.sensor_test import SensorTest

NUMBERS = yaml.safe_load((CORE.parent / "config" / "sensor_test.yaml").read_text(encoding="utf-8"))
CLOSE = 1e-6
"""Relative distance of a threshold from the oracle's evidence; both compute to rounding."""


class Both(InnerController):
    """The sensor test in C and the oracle, told the same."""

    def __init__(self, draw):
        super().__init__(**{"estimator.history": 0.3})
        values = {name: np.array(value) * draw.uniform(0.7, 1.4, np.shape(value)) for name, value in NUMBERS.items()}
        # Short windows and small thresholds, so that much happens within seconds.
        values["windows"] = np.sort(0.3 * values["windows"])
        for name in ("frozen", "doubtful", "memory", "pose_spacing", "lasting", "sliding"):
            values[name] = values[name] * 10.0 ** draw.uniform(-1.0, 0.0)
        values["gains"][1] *= 0.1
        values["scatter"][1], values["late"] = draw.integers(3, 25), [draw.uniform(1.0, 9.0), draw.uniform(0.8, 0.99)]
        values |= {"often": float(draw.integers(2, 5)), "enough": 8.0, "far": draw.uniform(0.5, 9.0)}
        values |= {"monitor_trust": draw.uniform(0.05, 0.6), "monitor_turn_ratio": draw.uniform(1.02, 1.2)}
        values["largest_command"] = 10.0 ** draw.uniform(-2.0, 0.3, 2)
        self.fields = {name for name, _ in self.ffi.typeof("ddmpc_constants").fields} & set(values)
        for name in self.fields:
            self.set(name, values[name])
        values["stamp_history"] = self.k.stamp_history
        model = self.controller.model.discretise(self.k.sample_time)
        self.oracle = SensorTest(SimpleNamespace(**values), model, self.k.wheel_yaw_ratio)
        self.lib.ddmpc_monitor_clear(self.c)
        self.commands = PastCommands(self.oracle.model, 20, 0)
        self.c.estimator.nodes, self.c.estimator.first = 1, 0
        self.draw, self.t, self.poses = draw, 10.0, 0

    def set(self, name, value):
        setattr(self.k, name, value.tolist() if isinstance(value, np.ndarray) else value)

    def sample(self, t, command, wheels, rate, slip, theta):
        """Advance one sample with a command, and readings of wheels (2) and gyro (1), or None."""
        ffi, lib, c, self.t = self.ffi, self.lib, self.c, t
        self.commands.append(command)
        lib.ddmpc_estimator_append(c, ffi.new("real[]", command.tolist()))
        newest = c.sizes.window + c.sizes.history + 1
        lib.ddmpc_monitor_predict(c, c.estimator.commands + 2 * newest)
        self.oracle.predict(self.commands)
        n, mean = c.sizes.states, c.estimator.node[0].posterior.mean
        mean[n : n + 16] = [*slip, 0.3, 0.0, 0.0, 0.0, 0.0, theta]
        values = [*([] if wheels is None else wheels), *([] if rate is None else [rate])]
        twists = ffi.new("ddmpc_checked_twist[3]", [{"value": value} for value in values])
        lib.ddmpc_monitor_move(c, t, twists, 0 if wheels is None else 2, len(values))
        self.oracle.move(t, wheels, rate, np.array(slip), theta)
        assert lib.ddmpc_monitor_doubts(c, t) == bits(self.oracle.doubts(t))
        assert max(abs(c.monitor.now.sum[i]) for i in range(9)) <= max(self.oracle.k.far, np.pi)

    def pose(self, stamp, value, covariance):
        """Judge a pose in both, with thresholds on either side of the coming evidence of the oracle."""
        for name in ("plausible", "enough", "margin"):
            setattr(self.oracle.k, name, float(NUMBERS.get(name, 8.0)))
        if self.draw.random() < 0.6:
            self._choose(stamp, value, covariance)
        for name in ("plausible", "enough", "margin"):
            self.set(name, getattr(self.oracle.k, name))
        fields = {"stamp": stamp, "value": list(value), "covariance": covariance.tolist()}
        pose = self.ffi.new("ddmpc_checked_pose *", fields)
        newly = self.lib.ddmpc_monitor_judge(self.c, pose)
        assert newly == bits(self.oracle.judge(stamp, value, covariance))
        self.lib.ddmpc_monitor_widen(self.c, pose)
        wide, doubt = self.oracle.widen(covariance)
        assert np.allclose([list(row) for row in pose.covariance], wide, rtol=1e-9, atol=0.0)
        assert np.allclose(list(pose.doubt), doubt, rtol=1e-9)
        self.poses += 1

    def _choose(self, stamp, value, covariance):
        k, draw, side = self.oracle.k, self.draw, self.draw.choice([-CLOSE, CLOSE])
        honest, _ = self._foretold(stamp, value, covariance)
        if honest and draw.random() < 0.7:
            k.plausible = (1.0 + side) * draw.choice(honest)
        honest, evidence = self._foretold(stamp, value, covariance)
        if evidence is None or not evidence.max() > 0.0:
            return
        i, side = draw.choice(np.flatnonzero(evidence > 0.0)), side * (evidence.max() + max(honest))
        others = max(0.0, *np.delete(evidence, i))
        if draw.random() < 0.5:
            k.enough, k.margin = evidence[i] + side, -1e9
        else:
            k.enough, k.margin = 0.5 * evidence[i], evidence[i] - others + side

    def _foretold(self, *pose):
        """Return the coming evidence of the oracle, which does not change."""
        same = (self.oracle.path, self.oracle.poses, self.oracle.model)
        other = copy.deepcopy(self.oracle, {id(part): part for part in same})
        evidence = [None]
        other.decide = lambda values, *_: evidence.append(values)
        other.judge(*pose)
        return other.honest, evidence[-1]

    def compare(self):
        """Compare the complete memory of both."""
        m, o, result, lib = self.c.monitor, self.oracle, self.c.result, self.lib
        result.reasons = 0
        lib.ddmpc_monitor_report(self.c)
        reasons = result.reasons
        told, gains = o.report(), (o.body_by_wheels, o.body_by_model, o.wheels_by_model)
        moved = o.now.sums - o.last.motion.sums if o.last else []
        begun = [i for i in range(3) if o.contradictions[i]]
        flags = [lib.DDMPC_POSES_SCATTER, lib.DDMPC_POSES_LATE, lib.DDMPC_TURNS_OTHERWISE]
        pairs = {
            "motion": (
                [m.now.sum[i] - m.last_motion.sum[i] for i in range(9)] if m.seen else [],
                [moved[0].real, moved[0].imag, *moved[1:].real] if o.last else [],
            ),
            "counts": (
                [m.moves, m.poses, m.residuals, m.delay, m.creeping, m.same, *m.contradictions],
                [len(o.path), len(o.poses), o.residuals, o.delay, o.creeping, o.same, *o.contradictions],
            ),
            "times": (
                [m.slipped, m.stood, m.next_pose, *m.agreed, *(m.since[i] for i in begun)],
                [o.slipped, o.stood, o.next_pose, *o.agreed, *(o.since[i] for i in begun)],
            ),
            "learned": ([*m.scatter, *m.residual, *m.misfit], [*o.scatter, *o.residual, *o.misfit]),
            "gains": (
                [x for g in (m.body_by_wheels, m.body_by_model, m.wheels_by_model) for x in (g[0] / g[1], g[1])],
                [x for g in gains for x in (g.value, g.sure)],
            ),
            "sensors": (
                [m.accused, m.repeating, reasons // lib.DDMPC_WHEELS_ACCUSED % 8, result.repeating],
                [bits(s) for s in (o.accused, o.repeating, told["accused"], told["repeating"])],
            ),
            "reasons": (
                [reasons & flag > 0 for flag in flags],
                [told["scatters"], told["late"], told["turns_otherwise"]],
            ),
            "result": (
                [result.pose_scatter, result.pose_delay, lib.ddmpc_monitor_delay(self.c), *result.turn_ratio],
                [told["pose_scatter"], told["pose_delay"], told["pose_delay"], *told["turn_ratio"]],
            ),
        }
        for name, (got, wanted) in pairs.items():
            same = np.allclose(np.array(got, float), np.array(wanted, float), rtol=1e-7, atol=1e-9)
            assert same, (name, got, wanted)


def bits(sensors):
    """Return sensors as the bits of C."""
    return sum(1 << sensor for sensor in sensors)


# What is wrong for a while, beside nothing; and by how much creeping poses go wrong each tick.
FAULTS = ("held", "spins", "pushed", "wheels stuck", "wheels dead", "wheels silent", "gyro stuck", "gyro turned")
FAULTS += ("gyro silent", "pose frozen", "pose drifts", "pose turns", "lost")
CREEPING = {"pose drifts": np.array([0.02, 0.03, 0.0]), "pose turns": np.array([0.0, 0.0, 0.02])}
SLIP = np.array([0.02, 1.0, 1.0, 0.9, 0.05, 0.03, -0.02, 0.0, 0.01, -0.02])


class Robot:
    """It follows the model more or less; what it does and what its sensors say is drawn."""

    def __init__(self, draw):
        self.draw, self.share = draw, draw.uniform(0.8, 1.25)
        self.noise, self.stated = draw.choice([0.0, 0.003, 0.03]), draw.choice([1.0, 1.0, 0.25])
        self.late, self.every = draw.choice([0, 5]), draw.integers(1, 4)
        self.poses, self.wheels, self.gyro, self.seen = [np.array([1.0, -2.0, 3.0])], np.zeros(2), 0.0, None
        self.began = self.tick = 0
        self.change()

    def change(self):
        """Draw a command and a fault or none, until a drawn tick."""
        self.command = self.draw.uniform([-0.6, -1.5], [0.9, 1.5]) * self.draw.choice([0.0, 1.0, 1.0, 1.0])
        self.fault, self.creeps = self.draw.choice(["", "", *FAULTS]), 10.0 ** self.draw.uniform(-1.5, 0.0)
        self.began, self.ends = self.tick, self.tick + self.draw.integers(10, 60)

    def advance(self, dt, output, ratio):
        """Move as the model says, but for what is wrong; `ratio` is the yaw rate by encoders over the model's."""
        self.tick += 1
        if self.tick == self.ends:
            self.change()
        rims = output * [1.0, self.share * ratio] * (self.fault != "held")
        v, omega = 0.0 * rims if self.fault == "spins" else rims / [1.0, ratio]
        if self.fault == "pushed":
            v, omega = v + 0.4, omega + 0.9
        x, y, theta = self.poses[-1]
        middle = theta + 0.5 * omega * dt
        self.poses.append(np.array([x + v * np.cos(middle) * dt, y + v * np.sin(middle) * dt, theta + omega * dt]))
        noise = self.draw.normal(0.0, 0.003, 3)
        if self.fault != "wheels stuck":
            self.wheels = rims * (self.fault != "wheels dead") + noise[:2]
        if self.fault != "gyro stuck":
            self.gyro = omega * (-1.0 if self.fault == "gyro turned" else 1.0) + noise[2]

    def readings(self):
        """Return readings of wheels (2) and gyro, None if missing."""
        comes = self.draw.random(2) < 0.9
        wheels = self.wheels if comes[0] and self.fault != "wheels silent" else None
        return wheels, float(self.gyro) if comes[1] and self.fault != "gyro silent" else None

    def slip(self):
        """Return the estimated slip, not finite at one tick."""
        is_lost = self.fault == "lost" and self.tick == self.began + 7
        return SLIP + self.draw.normal(0.0, 0.003, 10) + (np.nan if is_lost else 0.0)

    def pose(self):
        """Return a pose (3,) and its covariance."""
        if self.fault != "pose frozen" or self.seen is None:
            self.seen = self.poses[-1 - self.late] + self.draw.normal(0.0, 1.0, 3) * self.noise
            self.seen = self.seen + (self.tick - self.began) * self.creeps * CREEPING.get(self.fault, 0.0)
        return self.seen.copy(), np.diag([1.0, 1.4, 0.7]) * (max(self.noise, 0.003) * self.stated) ** 2 + 1e-7


def drive(both, ticks):
    """Drive a drawn robot; both are compared at each tick."""
    robot, t = Robot(both.draw), 10.0
    for tick in range(ticks):
        dt = both.draw.uniform(0.012, 0.03)
        t += dt
        robot.advance(dt, both.oracle.model.C @ both.oracle.state, both.k.wheel_yaw_ratio)
        both.sample(t, robot.command, *robot.readings(), robot.slip(), robot.poses[-1][2] - 2.6)
        if tick % robot.every == 0 and tick > 11:
            both.pose(t - 0.3 * dt, *robot.pose())
        both.compare()


SEEDS, ARGS = range(16), (250,)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_oracle_agrees(seed):
    both = Both(np.random.default_rng(seed))
    drive(both, *ARGS)
    assert both.poses > 50
