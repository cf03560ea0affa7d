"""What `models.plug_ins` finds of drive models."""

from pathlib import Path

from diffdrive_mpc.models.function_structure import FunctionStructure

PHYSICAL = FunctionStructure(
    structure="drive_physical",
    name="p2_physical",
    title="p2_physical",
    rank=10,
    package=__package__,
    loader="drive_model:load_drive",
    file="drive_model:PhysicalFile",
    finder_function="finding:find_physical",
    shipped=Path(__file__).with_name("p2_physical.yaml"),
    config=Path(__file__).parent / "configurations" / "p2_physical.yaml",
)
EXPERIMENTAL = FunctionStructure(
    structure="drive_experimental",
    name="p2_experimental",
    title="p2_experimental",
    rank=20,
    package=__package__,
    loader="drive_model:load_drive",
    file="drive_model:ExperimentalFile",
    finder_function="finding:find_experimental",
    shipped=Path(__file__).with_name("p2_experimental.yaml"),
    config=Path(__file__).parent / "configurations" / "p2_experimental.yaml",
)
