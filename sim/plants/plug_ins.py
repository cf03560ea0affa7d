"""Plants and simulator parts of other packages, from the entry points of the group `diffdrive_mpc.plants`.

An entry is a `PlantKind` for plants named "KIND:NAME" or "KIND:NAME@PLANT", or a `PartKind` for parts that sensor files
list under `parts:`. An entry of the same name in `diffdrive_mpc.columns` is a `RunColumns`, which presents the records.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

from diffdrive_mpc.models.interface import FloatArray, TrackingController
from diffdrive_mpc.models.plug_ins import plug_in
from diffdrive_mpc.sim.plants.plant import Plant


class PlantKind(Protocol):
    """Kind of plants that extend other plants, for instance by obstacles."""

    def make_plant(self, name: str, plant: str, **options: Any) -> Plant:  # noqa: ANN401 - see `make_plant`
        """Build the plant `name`, which extends the plant named `plant`; for options see `sim.make_plant`."""
        ...

    def settings(self, name: str, plant: str) -> Mapping[str, object]:
        """Return values of the controller's configuration for the plant by dotted key."""
        ...

    def reference(self, name: str, seed: int, limits: Any) -> Any:  # noqa: ANN401 - trajectories are types of `mpc`
        """Return the trajectory of the plant within the limits of the robot; None if the plant has no trajectory."""
        ...


class Scene(Protocol):
    """Geometry around the robot in the physics, as parts of its MJCF model."""

    @property
    def assets(self) -> str:
        """MJCF of the assets."""
        ...

    @property
    def obstacles(self) -> str:
        """MJCF of the bodies in the world body."""
        ...

    def hull(self, axle_height: float) -> str:
        """Return MJCF of the hull in the robot's body, whose origin is `axle_height` above the surface [m]."""
        ...

    def enter(self, model: Any, data: Any) -> None:  # noqa: ANN401 - MuJoCo has no types
        """Receive the compiled model before the robot settles on its wheels."""
        ...

    def restart(self) -> None:
        """Reset the scene for a new run."""
        ...

    def step(self) -> None:
        """Advance the physics by one step."""
        ...


class SimulatorPart(Protocol):
    """Device of the robot that observes its motors."""

    @property
    def value(self) -> FloatArray:
        """Readings at the current tick (k,)."""
        ...

    def record(self, values: FloatArray) -> object:
        """Return the record of a run from the readings of its ticks (n, k)."""
        ...

    def reset(self) -> None:
        """Reset to rest, and restart the noise."""
        ...

    def take(self, motors: FloatArray) -> None:
        """Process the motor data of a sample: (steps, 2, 4) torques [N m] and wheel speeds [rad/s]."""
        ...


class PartKind(Protocol):
    """Kind of simulator parts."""

    def make_part(self, sensor: object, robot: object, seed: int) -> SimulatorPart:
        """Build a part from the values under `parts:` in a sensor file and in a robot file."""
        ...


@runtime_checkable
class Surrounded(Protocol):
    """Plant with surroundings that the controller observes; the plant can end a run."""

    @property
    def time_limit(self) -> float:
        """Time limit of the run [s]."""
        ...

    def show(self, controller: TrackingController) -> None:
        """Pass the observations that are delivered at the current tick to the controller; called once per tick."""
        ...

    def is_over(self, goal: FloatArray) -> bool:
        """Return True if the run is complete; called after the end of the reference at the pose `goal` (3,)."""
        ...


class RunColumns:
    """Base class for the presentation of a part's records: columns, summary, table and marks in the path figure.

    A package registers an instance in `diffdrive_mpc.columns` under the name of the records in `Run.parts`.
    """

    def series(self, run: Any) -> Mapping[str, FloatArray]:  # noqa: ANN401 - importing Run would be circular
        """Return time series (n,) by name for `Run.columns` and logs."""
        del run
        return {}

    def row(self, run: Any) -> Mapping[str, object]:  # noqa: ANN401
        """Return values for the row of the run in comparisons, by column."""
        del run
        return {}

    def summary(self, run: Any) -> str:  # noqa: ANN401
        """Return a line for the summary of a run, or an empty string."""
        del run
        return ""

    def table(self, rows: Any) -> Any:  # noqa: ANN401 - a DataFrame and a table of the bench
        """Return a table of rows; None if there is no table."""
        del rows

    def draw(self, axes: Any, run: Any) -> None:  # noqa: ANN401 - axes of matplotlib
        """Draw marks into the axes of the path figure."""


def columns_of(run: Any) -> list[RunColumns]:  # noqa: ANN401 - importing Run would be circular
    """Return the `RunColumns` of the parts of a run, in the order of the parts."""
    return [plug_in("columns", name) for name in run.parts]


def make_part(name: str, sensor: object, robot: object, seed: int) -> SimulatorPart:
    """Build the simulator part `name`.

    Raises MissingPackageError if its package is not installed, and ConfigError if its values are invalid.
    """
    kind: PartKind = plug_in("plants", name)
    return kind.make_part(sensor, robot, seed)
