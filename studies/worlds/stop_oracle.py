"""Whether a robot could have stopped before a person: the same run again, with brakes from when the person was known.

It knows nothing of the controller: the commands of the run are sent to the same plant again, bit for bit, until the
person was known; from then on they go to zero at the braking limits, and MuJoCo says what that touches. Dead time and
lag of the motors are those of the plant.
"""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build_plant, load_reference
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim import Run
from diffdrive_mpc.sim.plants.plant import RobotLostError
from diffdrive_mpc.sim.plants.world_plant import WorldPlant
from diffdrive_mpc.sim.worlds.sight import in_view
from diffdrive_mpc.sim.worlds.world import World

_LOOKS = 2
"""From so many looks on the motion of a person can be known: two places are a velocity."""
_AFTER = 0.5
"""The replay goes on for so long after the end of the run [s]."""


def known_at(world: World, time: FloatArray, pose: FloatArray) -> FloatArray:
    """(movers,) when the motion of each mover could be known to the controller [s]; infinite for never.

    Two looks in turn have had it in view, and the second of them has arrived. `time` (n,) and `pose` (n, 3) are those
    of a run.
    """
    sight = world.sight
    looks = np.arange(0.0, time[-1] + 1e-9, sight.period)
    ticks = np.minimum(np.searchsorted(time + 1e-9, looks), len(time) - 1)
    found = np.full(len(world.movers), np.inf)
    for i, mover in enumerate(world.movers):
        row = 0
        for k in ticks:
            row = row + 1 if in_view(mover, float(time[k]), pose[k], world.shapes(float(time[k])), sight) else 0
            if row == _LOOKS:
                found[i] = time[k] + sight.latency
                break
    return found


def stop_was_possible(case: Case, run: Run) -> bool | None:
    """Whether braking from when the persons were known would have touched nobody while moving.

    None where nobody could be known of before the end of the run: then there was nothing to stop for, or no chance.
    """
    assert run.world is not None
    known = known_at(run.world, run.time, run.true_pose)
    first = float(known.min(initial=np.inf))
    if not first <= run.time[-1]:
        return None
    plant = build_plant(case)
    assert isinstance(plant, WorldPlant)
    plant.reset(load_reference(case).sample([0.0]).pose[0])
    slew = load_robot().command_slew
    step = np.array([slew.v, slew.omega]) * plant.sample_time
    command = np.zeros(2)
    try:
        while plant.time < run.time[-1] + _AFTER:
            if plant.time < first:
                k = min(int(np.searchsorted(run.time, plant.time - 1e-9)), len(run.time) - 1)
                command = run.command[k]
            else:
                command = np.sign(command) * np.maximum(np.abs(command) - step, 0.0)
            plant.advance(command)
    except RobotLostError:
        return False
    return True
