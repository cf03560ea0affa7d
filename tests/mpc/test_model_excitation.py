"""Every member of either family keeps to the room and to the limits; the search finds more than chance does."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_mpc import ConfigError, load_trajectory
from diffdrive_mpc.models.identification.fit.noise import DriveInformation
from diffdrive_mpc.models.load import load_linear_model
from diffdrive_mpc.mpc.trajectories import model_excitation as searched
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.model_excitation import Room, model_excitation, path_of, write_model_drive

LIMITS = TrajectoryLimits(v=0.6, omega=1.0, v_acceleration=1.5, omega_acceleration=4.0)
TICK = searched.model_excitation_settings().tick
INFORMATION = DriveInformation(load_linear_model("sm"), (0.01, 0.02))


def worth(twists):
    return INFORMATION.log_determinant(np.repeat(twists, 5, axis=0), TICK / 5)


@settings(deadline=None, max_examples=30)
@given(
    family=st.sampled_from([searched._Steps, searched._Sines]),
    seed=st.integers(0, 2**31),
    length=st.floats(1.2, 8.0),
    width=st.floats(1.2, 8.0),
    seconds=st.floats(10.0, 40.0),
    v=st.floats(0.05, 2.0),
    omega=st.floats(0.1, 3.0),
)
def test_every_member_keeps_to_room_and_limits(family, seed, length, width, seconds, v, omega):
    room, limits = Room(length, width), TrajectoryLimits(v, omega, 1.0, 3.0)
    member = family(room, seconds, limits)
    twists = member.twists(np.random.default_rng(seed).uniform(size=member.genes))
    assert len(twists) == pytest.approx(seconds / TICK, abs=1.01)
    assert (np.abs(twists) <= np.array([v, omega]) + 1e-9).all()
    steps = np.diff(np.vstack([np.zeros(2), twists, np.zeros(2)]), axis=0)
    assert (np.abs(steps) <= TICK * np.array([1.0, 3.0]) + 1e-9).all()
    assert (np.abs(path_of(twists, TICK)[:, :2]) <= room.reach + 1e-6).all()


def test_the_search_finds_more_than_chance_and_the_same_again(monkeypatch):
    quick = searched.model_excitation_settings().model_copy(update={"population": 8, "generations": 4})
    monkeypatch.setattr(searched, "model_excitation_settings", lambda: quick)
    room = Room(4.0, 3.0)
    drive = model_excitation(room, 15.0, LIMITS, worth, seed=3)
    again = model_excitation(room, 15.0, LIMITS, worth, seed=3)
    assert np.array_equal(drive.twists, again.twists)
    stream = np.random.default_rng(4)
    for name, family in (("steps", searched._Steps), ("multi-sine", searched._Sines)):
        member = family(room, 15.0, LIMITS)
        chance = [worth(member.twists(stream.uniform(size=member.genes))) for _ in range(8)]
        assert drive.worth[name] > np.median(chance)
    assert worth(drive.twists) == pytest.approx(max(drive.worth.values()))


def test_the_file_is_the_drive(tmp_path):
    member = searched._Steps(Room(4.0, 3.0), 20.0, LIMITS)
    twists = member.twists(np.random.default_rng(1).uniform(size=member.genes))
    write_model_drive(tmp_path / "drive.yaml", searched.ModelDrive("steps", twists, {}), TICK)
    drive = load_trajectory(tmp_path / "drive.yaml")
    # The ramp of the first twist from rest, and of the last one to it, take time of their own.
    assert drive.duration == pytest.approx(len(twists) * TICK, abs=0.3)
    assert drive.sample([drive.duration]).pose[0] == pytest.approx(path_of(twists, TICK)[-1], abs=5e-3)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Room(1.0, 3.0), "a room of 1 by 3 m"),
        (lambda: Room(float("nan"), 3.0), "a room of nan"),
        (lambda: model_excitation(Room(4.0, 3.0), 3.0, LIMITS, worth), "3 s: a drive that tells"),
    ],
)
def test_what_cannot_be_is_said(make, said):
    with pytest.raises(ConfigError, match=said):
        make()
