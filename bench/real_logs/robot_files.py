"""The files that a controller and a simulated stand-in of an identified robot need: model, configuration, surface."""

from __future__ import annotations

from datetime import date
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.real_logs.protocol import Proof
from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.structures.identified import model_file, write_model_file
from diffdrive_mpc.mpc.config.schema import Limits

MODEL, CONFIG, SURFACE = "model.yaml", "config.yaml", "surface.yaml"
FILES = (MODEL, CONFIG, SURFACE)
# Slew limits of the controller stay so many standard deviations inside those of the base.
_INSIDE = 2.0


def write_robot_files(proof: Proof, folder: Path) -> None:
    """Write `FILES` into `folder`; raises OSError if that cannot be done."""
    base = proof.base
    content = model_file(
        base.identified,
        name=proof.log.robot.partition(",")[0],
        source=f"{proof.log.robot}; {Path(proof.log.file).name}",
        records=[record.name for record in proof.train],
        date=date.today(),
        train_fit_percent=base.fit_percent(proof.train)[[0, 2]],
        validation_fit_percent=base.fit_percent(proof.held_out)[[0, 2]],
        notes="v is that of the encoders; omega that of the gyro",
    )
    write_model_file(folder / MODEL, content)
    (folder / CONFIG).write_text(configuration(proof), encoding="utf-8")
    (folder / SURFACE).write_text(surface(proof), encoding="utf-8")


def configuration(proof: Proof) -> str:
    """Text of a controller configuration that keeps inside what the base follows, with a reason beside each value."""
    base, usual = proof.base, Limits()
    effects = BaseEffects.model_validate(base.identified.content["base_effects"])
    largest = np.abs(np.concatenate([record.command for record in proof.train])).max(axis=0)
    lines = [
        f"# Controller of {proof.log.robot}. Fields left out keep the schema's default: diffdrive-mpc config schema",
        f"model: {MODEL}",
        f"# The log knows commands up to {largest[0]:.2f} m/s and {largest[1]:.2f} rad/s; beyond, it guesses.",
    ]
    limits: list[str] = []
    if effects.twist_slew is not None:
        found = base.identified.parameters
        for name in ("v", "omega"):
            slew = found.value(f"slew.{name}") - _INSIDE * found.deviation(f"slew.{name}")
            default = getattr(usual, f"{name}_slew")
            reason = "what the base follows, less two standard deviations" if slew < default else "the default"
            limits.append(f"  {name}_slew: {min(slew, default):.4g}   # {reason}: inside it the linear model holds")
    wheels = effects.wheel_command
    if wheels is not None and wheels.top_speed is not None:
        gain = base.identified.content["channels"]["v"]["gain"]
        limits.append(f"  wheel_speed: {gain * wheels.top_speed:.4g}   # m/s at the rim, where the motors saturate")
    lines += ["limits:", *limits] if limits else []
    if wheels is not None:
        lines += [
            "wheels:",
            f"  track: {wheels.track:.4g}   # m, by which the base turns omega_ref into rim speeds",
            f"  encoder_track: {base.point['encoders.track']:.4g}   # m, by which the log's omega was computed",
        ]
    return "\n".join(lines) + "\n"


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
