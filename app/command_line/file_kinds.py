"""Which kinds of YAML files there are, where the shipped ones lie, and where their JSON Schema does.

A schema lies in the room of its reader, in `schemas/`, so that the same relative path leads to it from a shipped file
in a clone and in an installed wheel.
"""

from __future__ import annotations

import difflib

from diffdrive_mpc.models.file_kind import FileKind
from diffdrive_mpc.models.function_structure import function_structures
from diffdrive_mpc.models.plug_ins import plug_ins

KINDS: dict[str, FileKind] = {
    kind.name: kind
    for kind in (
        FileKind(
            "controller",
            "mpc",
            "configuration of a controller",
            "--config",
            ("config/parameters/*.yaml",),
            elsewhere=tuple(one.config for one in function_structures().values() if one.config),
        ),
        FileKind("monitor", "mpc", "rules of the monitor", "monitor --rules", ("monitor/rules/*.yaml",)),
        FileKind("trajectory", "mpc", "path to follow", "--trajectory", ("trajectories/built_in/*.yaml",)),
        FileKind(
            "model",
            "models",
            "velocity model",
            "--model",
            ("parameters/*.yaml", "parameters/robots/*.yaml"),
            besides=("robot.yaml",),
            elsewhere=tuple(
                function_structure.shipped
                for function_structure in function_structures().values()
                if function_structure.shipped
            ),
        ),
        FileKind("mapping", "models", "columns or topics of a log", "--mapping", ("logs/mappings/*.yaml",)),
        FileKind(
            "stated-robot", "models", "what the maker states of a robot", "identify --robot", ("stated_robots/*.yaml",)
        ),
        FileKind("vehicle", "models", "robot as the floor feels it", "load_vehicle", ("turn_costs/vehicles/*.yaml",)),
        FileKind("drive", "models", "motors and drivers", "load_drive_constants", ("turn_costs/drives/*.yaml",)),
        FileKind(
            "turn-costs",
            "models",
            "what a robot does and pays in turns on a floor",
            "plan --costs",
            ("turn_costs/floors/*.yaml",),
        ),
        FileKind("robot", "sim", "simulated robot", "--plant mujoco:FILE", ("plants/robots/*.yaml",)),
        FileKind("surface", "sim", "floor", "--surface", ("plants/surfaces/*.yaml",)),
        FileKind("sensors", "sim", "sensor set", "--sensors", ("sensing/sensor_sets/*.yaml",)),
        FileKind("scenario", "sim", "what happens to the robot", "--scenario", ("disturbances/scenarios/*.yaml",)),
        FileKind(
            "world", "sim", "what stands and moves around the robot", "--plant world:FILE", ("worlds/shipped/*.yaml",)
        ),
        FileKind("experiment", "bench", "what varies in which parts, and the tables of it", "bench --spec"),
        FileKind("campaign", "bench", "runs drawn from distributions", "campaign FILE"),
        FileKind("proof", "app", "campaign with maps and boundaries", "prove --campaign", ("proof/*.yaml",)),
        FileKind("tune", "app", "what is tuned, and on which runs", "tune --plan", ("tune/default.yaml",)),
        FileKind(
            "conditions",
            "bench",
            "robots, floors and faults by name",
            "robustness --conditions",
            ("conditions.yaml",),
        ),
        *plug_ins("files"),
    )
}
"""By name."""


def kind_of(name: str) -> FileKind:
    """The kind `name`; raises ConfigError where there is none."""
    if name in KINDS:
        return KINDS[name]
    from diffdrive_mpc.models.checked_yaml import ConfigError  # noqa: PLC0415 - shells complete without it

    near = difflib.get_close_matches(name, KINDS, n=1, cutoff=0.5)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    raise ConfigError(f"unknown kind of file '{name}': give one of {', '.join(KINDS)}{hint}")
