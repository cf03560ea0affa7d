"""Rules on what a simulation costs (P0, Table 3; P1, Table 5)."""

from __future__ import annotations

from collections.abc import Mapping

from diffdrive_mpc.bench.reproduce.experiments.cost import Cost
from diffdrive_mpc.bench.reproduce.findings.finding import Finding
from diffdrive_mpc.bench.reproduce.published import Published


def cost_findings(cost: Mapping[str, Cost], published: Published) -> list[Finding]:
    """Means decide; times differ from machine to machine."""
    took = {name: one.time_per_step[0] for name, one in cost.items()}
    held = {name: one.memory[0] for name, one in cost.items()}
    printed, rules = published.cost, published.rules
    return [
        Finding(
            f"a step of SM takes less than {rules.quicker:g} of the time of one of MBM",
            "P0, Table 3",
            f"{printed['sm'].time_per_step[0] / printed['mbm'].time_per_step[0]:.2f}",
            f"{took['sm'] / took['mbm']:.2f}",
            (took["sm"] < rules.quicker * took["mbm"],),
        ),
        Finding(
            "simulating SM takes less memory than simulating MBM",
            "P0, Table 3",
            f"{printed['sm'].memory[0] / printed['mbm'].memory[0]:.2f} of it",
            f"{held['sm'] / held['mbm']:.2f} of it",
            (held["sm"] < held["mbm"],),
        ),
        Finding(
            f"a step of SSM is more than {rules.much_quicker:g} times as quick as one of SM",
            "P0, Table 3 and P1, Table 5",
            f"{printed['sm'].time_per_step[0] / printed['ssm'].time_per_step[0]:.0f} times",
            f"{took['sm'] / took['ssm']:.1f} times",
            (took["sm"] > rules.much_quicker * took["ssm"],),
        ),
    ]
