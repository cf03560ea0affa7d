"""Names of plants; the module does not import the simulator, so the command line loads quickly."""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_mpc.models.plug_ins import known_packages, plug_in, plug_in_names

if TYPE_CHECKING:
    from diffdrive_mpc.sim.plants.plug_ins import PlantKind

PHYSICS = "mujoco"
"""Name of the physics plant, and prefix of other robots in the physics ("mujoco:NAME")."""
DRAWN = "drawn"
"""Prefix of robots of the market ("drawn:SEED"), see `sim/plants/market.yaml`."""
MODEL = "model"
"""Prefix of velocity models ("model:NAME")."""
BUILT_IN = (PHYSICS, DRAWN, MODEL)


def split_plant(name: str) -> tuple[PlantKind, str, str] | None:
    """Split "KIND:NAME" or "KIND:NAME@PLANT" into kind, NAME and PLANT; the default of PLANT is the physics.

    Returns None for built-in and unknown plants.

    Raises
    ------
    MissingPackageError
        If the package of the kind is not installed.
    """
    kind, colon, rest = name.partition(":")
    if not colon or kind in BUILT_IN or kind not in {*plug_in_names("plants"), *known_packages().get("plants", {})}:
        return None
    part = plug_in("plants", kind)
    if not hasattr(part, "make_plant"):
        return None
    argument, separator, plant = rest.rpartition("@")
    # NAME may be a path that contains "@", so the text after "@" counts as PLANT only if it is the name of a plant.
    is_plant = bool(separator) and plant.partition(":")[0] in BUILT_IN
    return (part, argument, plant) if is_plant else (part, rest, PHYSICS)
