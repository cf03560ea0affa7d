"""What `models.plug_ins` finds of hybrids."""

from diffdrive_mpc.models.function_structure import FunctionStructure

HYBRID = FunctionStructure(
    structure="hybrid",
    name="hybrid",
    title="hybrid",
    rank=30,
    package=__package__,
    loader="hybrid_model:load_hybrid",
    file="hybrid_model:HybridFile",
    finder_function="finding:find_hybrid",
    check="training:libraries",
    slow=True,
)
