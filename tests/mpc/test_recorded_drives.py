"""Recorded drives: commands, estimates and reports under faults, disturbances and settings are as recorded.

The other tests state what must happen; this one detects any change of the core. Record an intended change with
`PYTHONPATH=tests:tests/mpc python tests/mpc/test_recorded_drives.py`, and read the difference.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import test_core_against_oracle as events
import test_monitor as faults
import yaml
from ideal_robot import PROMPT, IdealRobot
from test_curved_slip import CURVES, estimator_settings
from test_fence import FENCE
from test_reentry import wheels

from diffdrive_mpc import Controller, load_config, load_model, load_trajectory
from diffdrive_mpc.mpc.problem.slip import Slip
from diffdrive_mpc.mpc.trajectories.moved import starting_at

FILE = Path(__file__).with_suffix(".yaml")
TICKS, DT = 400, faults.DT


def scale(field, factor, first=0, end=TICKS):
    """Return a change: readings of a sensor are multiplied by `factor` from the tick `first` to the tick `end`."""

    def change(k, m):
        reading = getattr(m, field)
        scaled = replace(m, **{field: replace(reading, value=np.asarray(reading.value) * factor)})
        return scaled if first <= k < end else m

    return change


def drop(field, first=0, end=TICKS, every=TICKS):
    """Return a change: a sensor is silent from `first` to `end`, except at multiples of `every`."""
    return lambda k, m: replace(m, **{field: None}) if first <= k < end and (k % every or k == 0) else m


def chain(*changes):
    def change(k, m):
        for part in changes:
            m = part(k, m)
        return m

    return change


def corrupt_in_turn():
    """Return a change: each corruption of the comparison with the oracle lasts for four ticks."""
    queue, corruptions = [], list(events.CORRUPTIONS.values())

    def change(k, m):
        queue[k:] = [m.pose]
        return corruptions[k // 4 % len(corruptions)](m, queue)

    return change


def with_wheels(**limits):
    """Return options of `record`: a robot whose wheels have limits, without a lag of the encoders."""

    class Limited(IdealRobot):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            self.base = wheels(**limits)

        def advance(self, command):
            super().advance(self.base(command))

    return {"robot": Limited, **PROMPT}


# Change of measurements, and options of `record`.
SCENARIOS = {
    **{name: (change, {"path": path}) for name, (change, path, *_) in faults.FAULTS.items()},
    "poses frozen": (faults.POSE_FAULTS["frozen"][0], {}),
    "poses frozen, straight on": (faults.POSE_FAULTS["frozen, straight on"][0], {"path": "cane"}),
    "poses turning": (faults.POSE_FAULTS["turning"][0], {}),
    "poses drifting": (faults.POSE_FAULTS["drifting"][0], {"path": "cane"}),
    "poses scatter": (faults.scatter_poses, {}),
    "rare poses scatter": (chain(faults.scatter_poses, drop("pose", every=13)), {}),
    "rare poses": (drop("pose", every=25), {}),
    "no poses for 2 s": (drop("pose", 150, 250), {}),
    "gyro at zero from the start": (scale("yaw_rate", 0.0), {"path": "circle"}),
    "gyro inverted": (scale("yaw_rate", -1.0), {"path": "square"}),
    "gyro at half": (scale("yaw_rate", 0.5), {}),
    "gyro doubled": (scale("yaw_rate", 2.0), {"path": "circle"}),
    "gyro in degrees": (scale("yaw_rate", 57.3), {"path": "square"}),
    "gyro biased": (faults.corrupt_sensor("yaw_rate", lambda rate, _: rate + 0.05), {}),
    "gyro silent": (drop("yaw_rate", 100, 220), {}),
    "wheels at half": (scale("wheel_twist", 0.5), {}),
    "wheels at 0.8 without a gyro": (chain(scale("wheel_twist", 0.8), drop("yaw_rate")), {}),
    "wheels with exchanged sides": (scale("wheel_twist", np.array([1.0, -1.0])), {"path": "square"}),
    "wheels reversed": (scale("wheel_twist", -1.0), {}),
    "wheels at zero for a while": (scale("wheel_twist", 0.0, 150, 225), {"path": "circle"}),
    "wheels in mm/s": (scale("wheel_twist", 1000.0, 150), {}),
    "wheels silent": (drop("wheel_twist", 100, 220), {"path": "cane"}),
    "rare wheels": (drop("wheel_twist", every=4), {}),
    "wheels and gyro silent": (chain(drop("wheel_twist", 100, 130), drop("yaw_rate", 160, 190)), {"path": "square"}),
    "poses 1 tick late": (faults.delay_poses(1), {}),
    "poses 3 ticks late": (faults.delay_poses(3), {"path": "square"}),
    "poses 10 ticks late": (faults.delay_poses(10), {"path": "k_turn"}),
    "poses late, no gyro": (chain(faults.delay_poses(7), drop("yaw_rate")), {}),
    "poses late, no wheels": (chain(faults.delay_poses(5), drop("wheel_twist")), {"path": "circle"}),
    "odd measurements": (corrupt_in_turn(), {}),
    "held": (None, {"robot": faults.HeldRobot}),
    "held, encoders at zero": (None, {"robot": faults.QuietHeldRobot, "path": "cane"}),
    "spinning wheels": (None, {"robot": faults.SpinningRobot}),
    "pushed": (None, {"robot": faults.PushedRobot, "path": "circle"}),
    "on a slope": (None, {"robot": faults.SlidingRobot, "path": "square"}),
    "slow wheels": (None, {"path": "circle", **with_wheels(max_speed=0.44)}),
    "slow wheels recover": (None, with_wheels(max_speed=0.4, end=4.0)),
    "slow wheels on the spot": (None, {"path": "square", **with_wheels(max_speed=0.08, turning=True)}),
    "slow wheels, backwards": (None, {"path": "k_turn", **with_wheels(max_speed=0.2)}),
    "a weak wheel": (None, {"path": "slalom", **with_wheels(share=(1.0, 0.85))}),
    "weak wheels": (None, {"path": "circle", **with_wheels(share=(0.6, 0.6))}),
    "a blocked wheel": (None, {"path": "slalom", **with_wheels(share=(1.0, 0.1))}),
    "low gains": (None, {"slip": Slip(longitudinal_gain=0.6, yaw_gain=0.7), "path": "circle"}),
}
EVENTS = ("displace", "displace_far", "false_pose", "no_pose_for_long", "hold", "short_failure", "long_failure")
EVENTS += ("no_odometry", "new_limits", "no_sensors", "wrong_times", "clock_set_back", "pause", "foreign_commands")
EVENTS += ("leap_twice", "halved_commands", "first_pose_wrong", "no_measurement")
SCENARIOS |= {name: (None, {"path": "circle", "ticks": 250, "event": getattr(events, name)}) for name in EVENTS}
RADIUS = {"limits.min_turn_radius": 0.6, "limits.min_commanded_radius": 0.5}
CUSP = {"limits.min_turn_radius": 0.5, "limits.min_commanded_radius": 0.5}
WEIGHTS = {"weights.v_increment": 20.0, "weights.omega_increment": 15.0, "weights.soft": 5.0, "weights.terminal": 2.0}
LATE = {"extra_dead_time.v": 0.07, "extra_dead_time.omega": 0.11, "compensation.delay": False}
SETTINGS = {
    "fence": {"path": "circle", "start": (0.4, 0.3, 0.2), **FENCE},
    "fence in the frame of poses": {"path": "cane", "start": (-0.8, 0.0, 0.5), "fence.frame": "poses", **FENCE},
    "fence, late commands": {"path": "cane", "start": (-0.9, 0.3, 0.5), **FENCE, **LATE},
    "fence, slow robot": {"path": "circle", "start": (0.2, 0.0, 0.2), "slower": 8.0, **FENCE},
    "soft limits": {"path": "k_turn", **events.SOFT},
    "soft and hard limits": {"path": "square", **events.SOFT, **events.HARD, "horizon": 12},
    "two-sided limits": {
        "path": "k_turn",
        **events.SOFT,
        **events.TWO_SIDED,
        "limits.v": {"forward": 0.9, "reverse": 0.65},
    },
    "turn radii": {"path": "slalom", **RADIUS},
    "turn radii, backwards": {"path": "reverse_slalom", **RADIUS, **events.SOFT},
    "turn radii at a cusp, by OSQP": {"path": "k_turn", "from_end": 5.4, "ticks": 60, **CUSP, **events.OSQP},
    "start beside the path": {"displaced": (0.2, -0.3, 0.6)},
    "start far from the path": {"path": "square", "displaced": (-0.3, 0.6, -2.0)},
    "weights": WEIGHTS,
    "late commands": {"model": "sm", **LATE},
    "MBM, late": {"model": "mbm", "path": "slalom", **LATE, **WEIGHTS},
    "MBM": {"model": "mbm", "path": "square"},
    "SM": {"model": "sm", "path": "figure8", "horizon": 60},
    "short horizon": {"horizon": 4, "path": "square", "reentry.wait": 0.05},
    "no compensation": {f"compensation.{name}": False for name in ("dead_time", "delay", "v_offset", "yaw_gain")},
    "curved slip": {**estimator_settings(CURVES), "slip": Slip(yaw_gain=0.7, side_slip=0.1)},
    "much slip": {"slip": Slip(yaw_gain=0.4, side_slip=0.05, turn_ahead=0.1), "path": "k_turn"},
    "wrong track": {"path": "circle", "wheels.encoder_track": 0.3},
    "sensor delays": {"sensors.wheels.delay": 0.05, "sensors.yaw_rate.lag": 0.03, "sensors.pose.delay": 0.04},
    "no monitor": {"monitor.enabled": False, "path": "slalom"},
    "no re-entry": {"reentry.enabled": False, "displaced": (0.1, 0.1, 0.2)},
    "end": {"path": "cane", "from_end": 2.0},
}
SCENARIOS |= {name: (None, {"ticks": 200, **options}) for name, options in SETTINGS.items()}


def record(
    change,
    *,
    path="s",
    robot=IdealRobot,
    slip=None,
    start=None,
    displaced=(0.0, 0.0, 0.0),
    model="ssm",
    ticks=TICKS,
    event=None,
    from_end=0.0,
    slower=1.0,
    **settings,
):
    """Drive and return the events, at which a report changes, and means of commands and estimated quantities."""
    reference = load_trajectory(path)
    reference = starting_at(reference, np.array(start)) if start else reference
    passed = reference.duration - from_end if from_end else 0.0
    pose = reference.sample([passed]).pose[0] + displaced
    velocity = replace(shipped := load_model(model), A=shipped.A / slower, B=shipped.B / slower)
    base = robot(velocity.discretise(DT), pose, slip=slip, noise=1.0, seed=1)
    controller = Controller(load_config(model, settings), velocity)
    controller.start(reference, -passed)
    methods = {name: getattr(controller, name) for name in ("resume", "update", "start")}
    both = SimpleNamespace(results=[], override=controller.set_applied_commands, **methods)
    reports, numbers, estimates = {}, [], []
    for k in range(ticks):
        m, t, hold = base.measure(), base.time, None
        m = m if change is None else change(k, m)
        t, m, hold = (t, m, None) if event is None else event(k, t, m, both)
        both.results.append(result := controller.step(t, m, hold))
        c = controller._c_result
        report = f"{result.mode} {c.reasons:x} {c.repeating} {c.implausible} {result.limited_by}".strip()
        if not reports or reports[max(reports)] != report:
            reports[k] = report
        # Without a rejected sensor, these ratios may be those of two rounding errors.
        reads = c.reads if result.unused_sensors else (0.0, 0.0, 0.0)
        learned = (*reads, *c.turn_ratio, c.direction, c.pose_scatter, c.pose_delay, min(c.reach, 10.0))
        planned = (0.0, 0.0) if result.planned_commands is None else np.mean(result.planned_commands, axis=0)
        numbers.append((*learned, result.progress, result.reference_delay, *result.command, *planned))
        if result.estimate:
            estimates.append((*result.estimate.mean, *result.estimate.deviation))
        base.advance(result.command)
    means = [float(f"{mean:.6g}") for mean in (*np.mean(numbers, axis=0), *np.mean(estimates, axis=0))]
    return {"reports": reports, "means": means}


@pytest.mark.parametrize("name", SCENARIOS)
def test_drive_is_as_recorded(name):
    change, options = SCENARIOS[name]
    recorded, driven = yaml.safe_load(FILE.read_text())[name], record(change, **options)
    assert driven["reports"] == recorded["reports"]
    assert driven["means"] == pytest.approx(recorded["means"], rel=1e-4, abs=1e-6)


if __name__ == "__main__":
    drives = {name: record(change, **options) for name, (change, options) in SCENARIOS.items()}
    FILE.write_text(yaml.safe_dump(drives, sort_keys=False, default_flow_style=None, width=120))
