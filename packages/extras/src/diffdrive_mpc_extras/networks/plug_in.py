"""What `models.plug_ins` finds of networks."""

from pathlib import Path

from diffdrive_mpc.models.function_structure import FunctionStructure

LSTM = FunctionStructure(
    structure="lstm",
    name="lstm",
    title="LSTM",
    rank=40,
    package=__package__,
    loader="network_model:load_network",
    file="network_model:NetworkFile",
    finder_function="finding:find_network",
    check="training:check_installed",
    shipped=Path(__file__).with_name("lstm.yaml"),
    config=Path(__file__).parent / "configurations" / "lstm.yaml",
    slow=True,
)
