"""The files that a controller and a simulated stand-in of an identified robot need."""

from __future__ import annotations

from pathlib import Path

from diffdrive_mpc.bench.studies.real_logs.protocol import Proof
from diffdrive_mpc.models.identification.from_logs import FILES as IDENTIFIED

SURFACE = "surface.yaml"
FILES = (*IDENTIFIED, SURFACE)


def write_robot_files(proof: Proof, folder: Path) -> None:
    """Write `FILES` into `folder`; raises OSError if that cannot be done."""
    proof.found.write(folder)
    (folder / SURFACE).write_text(surface(proof), encoding="utf-8")


def surface(proof: Proof) -> str:
    """Text of a surface file: what encoders count against what the body does, for a stand-in of this robot."""
    base = proof.base
    travel = base.pose.value("pose.travel") if base.pose else 1.0
    return (
        f"# {proof.log.robot}: for `model:` plants of the model file beside it, which has the yaw rate of the body.\n"
        "slip:\n"
        "  yaw_gain: 1.0\n"
        f"  wheel_yaw_gain: {1 / base.point['encoders.yaw_ratio']:.5g}   # true yaw rate over that of the encoders\n"
        f"  longitudinal_gain: {travel:.5g}   # true forward speed over that of the encoders\n"
        "  side_slip: 0.0   # s, not identified: poses cannot tell it from the sensor's place ahead\n"
    )
