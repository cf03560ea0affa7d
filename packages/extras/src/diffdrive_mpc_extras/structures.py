"""Velocity-model structures that this package registers; see `models.function_structure.FunctionStructure`."""

from pathlib import Path

from diffdrive_mpc.models.function_structure import FunctionStructure

_PACKAGE = Path(__file__).parent
_DRIVES, _NETWORKS = _PACKAGE / "drives", _PACKAGE / "networks"

PHYSICAL = FunctionStructure(
    structure="drive_physical",
    name="p2_physical",
    title="p2_physical",
    rank=10,
    package=f"{__package__}.drives",
    loader="drive_model:load_drive",
    file="drive_model:PhysicalFile",
    finder_function="finding:find_physical",
    shipped=_DRIVES / "p2_physical.yaml",
    config=_DRIVES / "configurations" / "p2_physical.yaml",
    robots=(_DRIVES / "p2_pioneer.yaml",),
)
EXPERIMENTAL = FunctionStructure(
    structure="drive_experimental",
    name="p2_experimental",
    title="p2_experimental",
    rank=20,
    package=f"{__package__}.drives",
    loader="drive_model:load_drive",
    file="drive_model:ExperimentalFile",
    finder_function="finding:find_experimental",
    shipped=_DRIVES / "p2_experimental.yaml",
    config=_DRIVES / "configurations" / "p2_experimental.yaml",
)
HYBRID = FunctionStructure(
    structure="hybrid",
    name="hybrid",
    title="hybrid",
    rank=30,
    package=f"{__package__}.hybrids",
    loader="hybrid_model:load_hybrid",
    file="hybrid_model:HybridFile",
    finder_function="finding:find_hybrid",
    check="training:import_jax",
    slow=True,
)
LSTM = FunctionStructure(
    structure="lstm",
    name="lstm",
    title="LSTM",
    rank=40,
    package=f"{__package__}.networks",
    loader="network_model:load_network",
    file="network_model:NetworkFile",
    finder_function="finding:find_network",
    check="training:check_installed",
    shipped=_NETWORKS / "lstm.yaml",
    config=_NETWORKS / "configurations" / "lstm.yaml",
    slow=True,
)
