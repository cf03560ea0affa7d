"""Feasibility of a reference before driving: the violated limit, its time and position, and a feasible duration."""

import numpy as np
import pytest

from diffdrive_mpc.models.interface import ReferenceSample
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc import Controller, Trajectory, load_config, load_trajectory
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.trajectories.feasibility import find_shortfall
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_commands, time_segments

FAST = TrajectoryLimits(v=2.0, omega=3.0, v_acceleration=1.0, omega_acceleration=2.0)


class SlowedReference:
    """Reference `reference` slowed to the duration `duration` [s]."""

    def __init__(self, reference, duration):
        self.reference, self.name, self.duration = reference, reference.name, duration

    def sample(self, times):
        factor = self.duration / self.reference.duration
        sample = self.reference.sample(np.asarray(times) / factor)
        return ReferenceSample(sample.pose, sample.twist / factor, sample.arc_length)


class PartOfReference:
    """Part of `reference` from the time `start` [s] on."""

    def __init__(self, reference, start):
        self.reference, self.start, self.name = reference, start, reference.name
        self.duration = reference.duration - start

    def sample(self, times):
        return self.reference.sample(np.maximum(times, 0.0) + self.start)


def drive(segments, **limits):
    """Return controller, reference of `segments`, and the shortfall of a robot with these limits."""
    controller = Controller(
        replace_values(load_config("ssm"), {f"limits.{key}": value for key, value in limits.items()})
    )
    reference = time_segments([Segment(v=v, omega=omega, duration=t) for v, omega, t in segments], FAST, name="drive")
    return controller, reference, controller.find_shortfall(reference)


@pytest.mark.parametrize(
    ("segments", "limits", "key", "needed"),
    [
        # The robot reverses at 0.3 m/s at most; the reference reverses at 0.6 m/s.
        ([(0.6, 0.0, 2.0), (-0.6, 0.0, 3.0)], {"v": {"forward": 1.5, "reverse": 0.3}}, "limits.v.reverse", 0.6),
        ([(1.2, 0.0, 4.0)], {"v_slew": {"accelerate": 4.0, "brake": 0.3}}, "limits.v_slew.brake", 1.0),
        ([(0.5, 0.0, 2.0), (0.6, -1.2, 4.0)], {"omega": {"left": 2.0, "right": 0.6}}, "limits.omega.right", 1.2),
        # The speed of the outer wheel is 1.0 m/s + 0.2 m * 1.0 rad/s.
        ([(0.5, 0.0, 2.0), (1.0, 1.0, 4.0)], {"wheel_speed": 0.9}, "limits.wheel_speed", 1.2),
    ],
)
def test_violated_limit_is_reported_with_side_value_and_time(segments, limits, key, needed):
    _, reference, shortfall = drive(segments, **limits)
    assert shortfall.key == key and shortfall.needed == pytest.approx(needed, rel=0.1)
    first = next(i for i, segment in enumerate(segments) if "brake" in key or i == len(segments) - 1)
    assert shortfall.time > (reference.breaks[first] if hasattr(reference, "breaks") else 0.0) - 0.5
    assert reference.sample([shortfall.time]).arc_length[0] == pytest.approx(shortfall.arc_length)
    assert f"infeasible from {shortfall.time:.2f} s" in str(shortfall) and f"{key} = " in str(shortfall)
    assert shortfall.behind > 0.04


def test_reported_duration_is_feasible_and_a_shorter_duration_is_not():
    controller, reference, shortfall = drive([(1.2, 0.9, 4.0)], omega=0.6, v_slew=0.7)
    assert controller.find_shortfall(SlowedReference(reference, shortfall.drivable)) is None
    assert controller.find_shortfall(SlowedReference(reference, 0.9 * shortfall.drivable)) is not None
    # The tolerated delay permits a duration slightly below that of the limit.
    assert shortfall.drivable == pytest.approx(reference.duration * 0.9 / 0.6, rel=0.15)


def test_distance_behind_a_brake_limit_follows_from_both_decelerations():
    # From 1 m/s, the reference brakes at 1 m/s^2 and the robot at 0.25 m/s^2: 1/2/0.25 - 1/2/1 = 1.5 m.
    _, reference, shortfall = drive([(1.0, 0.0, 4.0)], v_slew={"accelerate": 4.0, "brake": 0.25})
    assert shortfall.behind == pytest.approx(1.5, rel=0.05) and shortfall.time > reference.duration - 2.0


def test_shipped_paths_are_feasible_for_the_shipped_models():
    for name in ("mbm", "sm", "ssm", "two_delays"):
        controller = Controller(name)
        for path in ("circle", "square", "s", "cane"):
            assert controller.find_shortfall(load_trajectory(path, controller.config)) is None, (name, path)


def test_start_at_speed_is_reported():
    config, times = load_config("ssm"), np.linspace(0, 5, 200)
    model = Controller(config).model
    shortfall = find_shortfall(Trajectory.from_arrays(times, 0.85 * times, 0 * times), config, model)
    assert shortfall.key == "limits.v_slew" and shortfall.time < 0.3
    assert "it is at 0.85 m/s when the first command acts: start at rest or set start_delay" in str(shortfall)
    steady = time_commands([Segment(v=0.85, omega=0.3, duration=4.0)], FAST, name="steady")
    moving = PartOfReference(steady, 2.0)
    assert find_shortfall(moving, config, model) is not None
    assert find_shortfall(moving, config, model, is_moving=True) is None
    assert find_shortfall(Trajectory.from_waypoints([(0, 0), (1, 0)]), config, model) is None


def test_deficit_at_the_start_counts_only_if_it_remains_after_the_lag():
    config, rate = load_config("sm", {"limits.v_slew": 2.0}), np.eye(2) / 0.6
    slow_robot = VelocityModel("lag", "sm", -rate, rate, np.eye(2))
    straight = time_segments([Segment(v=0.5, omega=0.0, duration=4.0)], FAST, name="straight")
    assert find_shortfall(straight, config, slow_robot) is None
    assert find_shortfall(straight, replace_values(config, {"limits.v_slew": 0.2}), slow_robot).behind > 0.1
