"""What a commissioning found, as its report says it."""

from __future__ import annotations

from collections.abc import Mapping

from diffdrive_mpc.app.commission.ledger import Done
from diffdrive_mpc.bench.table import Table, number

STEPS = ("excite-slow", "record-slow", "learn", "excite", "record", "identify", "twin", "tune", "prove")
"""All of them, in order."""
_HEAD = """\
# Commissioning

Each step had to pass before the next one began. `model.yaml` and `config.yaml` are for the robot, `twin.yaml` is for
`simulate --plant mujoco:twin.yaml`, `proof.md` says how often runs on robots around the twin went how.

"""
_TAIL = """
## The first drive

With `config.yaml`, on its own floor, with room and a hand at the emergency stop: `first_circle.yaml` first. The proof
is of the twin and of robots around it, not of this robot: what its log did not show is not in it.
"""


def steps_table(steps: Mapping[str, Done], tuned: bool) -> Table:
    """Every step with its sentence and its cost."""
    shown = [name for name in STEPS if name in steps and (tuned or name != "tune")]
    rows = tuple((name, f"{steps[name].sentence}.", number(steps[name].processor_s, 1)) for name in shown)
    return Table("Steps", ("step", "result", "processor time [s]"), rows, 2)


def report_text(steps: Mapping[str, Done], tuned: bool) -> str:
    """`report.md`."""
    return _HEAD + steps_table(steps, tuned).markdown().rstrip() + "\n" + _TAIL
