"""Plants and simulator parts of other packages, by the entry points of the group `diffdrive_mpc.plants`.

An entry is a `PlantKind`, whose plants are called "KIND:NAME" or "KIND:NAME@PLANT", or a `PartKind`, which a sensor
file names under `parts:`. The entry of the same name in `diffdrive_mpc.columns`, a `RunColumns`, shows its records.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

from diffdrive_mpc.models.interface import FloatArray, TrackingController
from diffdrive_mpc.models.plug_ins import plug_in
from diffdrive_mpc.sim.plants.plant import Plant


class PlantKind(Protocol):
    """Plants of one kind around other plants."""

    def make_plant(self, name: str, plant: str, **options: Any) -> Plant:  # noqa: ANN401 - see `make_plant`
        """Make the plant NAME around the plant of a name, with the other options of `sim.make_plant`."""
        ...

    def settings(self, name: str, plant: str) -> Mapping[str, object]:
        """Return configuration values that the predictive controller needs for the plant, by dotted key."""
        ...

    def reference(self, name: str, seed: int, limits: Any) -> Any:  # noqa: ANN401 - trajectories are types of `mpc`
        """Return the trajectory that belongs to the plant, within the limits of the robot; None if it has none."""
        ...


class Scene(Protocol):
    """Geometry around the robot in the physics, as parts of its MJCF model."""

    @property
    def assets(self) -> str:
        """MJCF of the assets."""
        ...

    @property
    def obstacles(self) -> str:
        """MJCF of the bodies, for the world's body."""
        ...

    def hull(self, axle_height: float) -> str:
        """Return MJCF of the robot's hull for its body, whose origin is `axle_height` above the surface [m]."""
        ...

    def enter(self, model: Any, data: Any) -> None:  # noqa: ANN401 - MuJoCo has no types
        """Receive the compiled model before the robot settles on its wheels."""
        ...

    def restart(self) -> None:
        """Reset everything for a new run."""
        ...

    def step(self) -> None:
        """Advance the physics by one step."""
        ...


class SimulatorPart(Protocol):
    """Device on the robot that observes its motors."""

    @property
    def value(self) -> FloatArray:
        """Readings at the current tick (k,)."""
        ...

    def record(self, values: FloatArray) -> object:
        """Return the record of a run from the readings of its ticks (n, k)."""
        ...

    def reset(self) -> None:
        """Restart at rest, with the noise of the seed."""
        ...

    def take(self, motors: FloatArray) -> None:
        """Take the motors of one sample: (steps, 2, 4) torques [N m] and wheel speeds [rad/s]."""
        ...


class PartKind(Protocol):
    """Simulator parts of one kind."""

    def make_part(self, sensor: object, robot: object, seed: int) -> SimulatorPart:
        """Make the part from the values under `parts:` of a sensor file and of a robot file."""
        ...


@runtime_checkable
class Surrounded(Protocol):
    """Plant whose surroundings the controller observes, and which can end a run."""

    @property
    def time_limit(self) -> float:
        """Time by which the run ends [s]."""
        ...

    def show(self, controller: TrackingController) -> None:
        """Pass observations that arrived by the current tick to the controller; call once per tick."""
        ...

    def is_over(self, goal: FloatArray) -> bool:
        """Return True if the run needs no further tick after the end of the reference at `goal`, a pose (3,)."""
        ...


class RunColumns:
    """Base of what one part adds to a run: columns, a line of text, a table and marks in the figure of the path.

    A package registers an instance in `diffdrive_mpc.columns` under the name by which `Run.parts` holds the records.
    """

    def series(self, run: Any) -> Mapping[str, FloatArray]:  # noqa: ANN401 - a Run, whose module imports this one
        """Return columns over time (n,) by name, for `Run.columns` and logs."""
        del run
        return {}

    def row(self, run: Any) -> Mapping[str, object]:  # noqa: ANN401
        """Return columns of the run's row in a comparison."""
        del run
        return {}

    def summary(self, run: Any) -> str:  # noqa: ANN401
        """Return a line for the summary of a run; empty for none."""
        del run
        return ""

    def table(self, rows: Any) -> Any:  # noqa: ANN401 - a DataFrame and a table of the bench
        """Return a table of rows; None for none."""
        del rows

    def draw(self, axes: Any, run: Any) -> None:  # noqa: ANN401 - axes of matplotlib
        """Draw into the axes of the driven path."""


def columns_of(run: Any) -> list[RunColumns]:  # noqa: ANN401 - as above
    """Return the additions of the parts of a run, in order."""
    return [plug_in("columns", name) for name in run.parts]


def make_part(name: str, sensor: object, robot: object, seed: int) -> SimulatorPart:
    """Make the simulator part of a name; raises MissingPackageError or ConfigError if it cannot be used."""
    kind: PartKind = plug_in("plants", name)
    return kind.make_part(sensor, robot, seed)
