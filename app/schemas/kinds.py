"""Which kinds of YAML files there are, where the shipped ones lie, and where their JSON Schema does.

A schema lies in the room of its reader, in `schemas/`, so that the same relative path leads to it from a shipped file
in a clone and in an installed wheel.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).parents[2]


@dataclass(frozen=True)
class Kind:
    """One kind of file.

    Attributes
    ----------
    name
        Word of the command line.
    room
        The room that reads it.
    what
        What such a file says, in a few words.
    given
        Where such a file is given.
    shipped
        Patterns of the files that ship, from the room.
    besides
        Names of files that match them and are of another kind.
    """

    name: str
    room: str
    what: str
    given: str
    shipped: tuple[str, ...] = ()
    besides: tuple[str, ...] = ()

    @property
    def file(self) -> Path:
        """The schema."""
        return PACKAGE / self.room / "schemas" / f"{self.name}.schema.json"

    @property
    def files(self) -> list[Path]:
        """The shipped files of this kind."""
        found = (path for pattern in self.shipped for path in sorted((PACKAGE / self.room).glob(pattern)))
        return [path for path in found if path.name not in self.besides]

    def text(self) -> str:
        """The schema as it ships."""
        return self.file.read_text(encoding="utf-8")


KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind("controller", "mpc", "configuration of a controller", "--config", ("config/parameters/*.yaml",)),
        Kind("monitor", "mpc", "rules of the monitor", "monitor --rules", ("monitor/rules/*.yaml",)),
        Kind("trajectory", "mpc", "path to follow", "--trajectory", ("trajectories/built_in/*.yaml",)),
        Kind(
            "model",
            "models",
            "velocity model",
            "--model",
            ("parameters/*.yaml", "parameters/robots/*.yaml"),
            besides=("robot.yaml",),
        ),
        Kind("mapping", "models", "columns or topics of a log", "--mapping", ("logs/mappings/*.yaml",)),
        Kind("vehicle", "models", "robot as the floor feels it", "load_vehicle", ("terrain/vehicles/*.yaml",)),
        Kind("terrain", "models", "shear and slip of a floor", "load_terrain", ("terrain/terrains/*.yaml",)),
        Kind("drive", "models", "motors and drivers", "load_drive_constants", ("energy/drives/*.yaml",)),
        Kind(
            "turn-costs",
            "models",
            "what a robot does and pays in turns on a floor",
            "plan --costs",
            ("turn_costs/floors/*.yaml",),
        ),
        Kind("robot", "sim", "simulated robot", "--plant mujoco:FILE", ("plants/robots/*.yaml",)),
        Kind("surface", "sim", "floor", "--surface", ("plants/surfaces/*.yaml",)),
        Kind("sensors", "sim", "sensor set", "--sensors", ("sensing/sensor_sets/*.yaml",)),
        Kind("scenario", "sim", "what happens to the robot", "--scenario", ("disturbances/scenarios/*.yaml",)),
        Kind("world", "sim", "what stands and moves around the robot", "--world", ("worlds/shipped/*.yaml",)),
        Kind("campaign", "bench", "runs drawn from distributions", "campaign FILE"),
        Kind("proof", "app", "campaign with maps and boundaries", "prove --campaign", ("proof/*.yaml",)),
        Kind("tune", "app", "what is tuned, and on which runs", "tune --plan", ("tune/default.yaml",)),
        Kind(
            "conditions",
            "bench",
            "robots, floors and faults by name",
            "robustness --conditions",
            ("conditions.yaml",),
        ),
    )
}
"""By name."""


def kind_of(name: str) -> Kind:
    """The kind `name`; raises ConfigError where there is none."""
    if name in KINDS:
        return KINDS[name]
    from diffdrive_mpc.models.checked_yaml import ConfigError  # noqa: PLC0415 - shells complete without it

    near = difflib.get_close_matches(name, KINDS, n=1, cutoff=0.5)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    raise ConfigError(f"unknown kind of file '{name}': give one of {', '.join(KINDS)}{hint}")
