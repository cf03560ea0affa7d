"""The controller on a stand-in of an identified robot: its own model as the plant, so consistency and little more."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.identification.deliver.configuration import CONFIG_FILE, MODEL_FILE
from diffdrive_mpc.models.identification.fit.slip import SURFACE_FILE as SURFACE
from diffdrive_mpc.models.load import load_model
from diffdrive_mpc.models.robot import TwistBounds
from diffdrive_mpc.mpc import Controller, load_config
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.config.schema import Limits
from diffdrive_mpc.mpc.trajectories.moved import scaled_to_robot
from diffdrive_mpc.sim import make_plant, simulate
from studies.real_logs.protocol import LogProof

TRAJECTORIES = ("circle", "square", "s", "cane")


def write_robot_files(proof: LogProof, folder: Path) -> None:
    """Write `FILES` into `folder`; raises OSError if that cannot be done."""
    proof.found.write(folder)
    (folder / SURFACE).write_text(surface(proof), encoding="utf-8")


def surface(proof: LogProof) -> str:
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


@dataclass(frozen=True)
class Tracking:
    """Mean figures over seeds of one controller on one trajectory.

    Attributes
    ----------
    controller
        What it knows of the robot.
    trajectory
        Which.
    position_rmse, position_max
        [m]; the second the largest over all seeds.
    heading_rmse
        [rad].
    lateral_rmse
        [m].
    completed
        In how many of the runs the robot arrived.
    runs
        How many there were.
    """

    controller: str
    trajectory: str
    position_rmse: float
    position_max: float
    heading_rmse: float
    lateral_rmse: float
    completed: int
    runs: int


def drive(folder: Path, seeds: Sequence[int], on_run: Callable[[], None] | None = None) -> list[Tracking]:
    """Drive the four trajectories on the robot whose files are in `folder`, with what is known of its base and without.

    Without means the linear part of the same model and the default slew limits: path and controller ask for slopes that
    the base does not follow. Weights are the shipped ones. Each drives the trajectories as its own configuration scales
    them to the robot, at the configuration's sample time.

    Parameters
    ----------
    folder
        With the files of `write_robot_files`.
    seeds
        Of the sensors' noise.
    on_run
        Called after each run.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a file has a mistake.
    """
    usual = Limits()
    known, model = load_config(folder / CONFIG_FILE), load_model(folder / MODEL_FILE)
    ignorant = replace_values(known, {"limits.v_slew": usual.v_slew, "limits.omega_slew": usual.omega_slew})
    rows = []
    for name, config in (("knows the base's slew", known), ("linear part only", ignorant)):
        for trajectory in TRAJECTORIES:
            reference = scaled_to_robot(trajectory, config, model)
            drives = []
            for seed in seeds:
                plant = make_plant(
                    f"model:{folder / MODEL_FILE}",
                    surface=folder / SURFACE,
                    seed=seed,
                    sample_time=config.sample_time,
                    limits=TwistBounds(v=config.limits.v, omega=config.limits.omega),
                )
                drives.append(simulate(Controller(config), plant, reference).metrics)
                if on_run is not None:
                    on_run()
            rows.append(
                Tracking(
                    name,
                    trajectory,
                    float(np.mean([metrics.position_rmse_m for metrics in drives])),
                    float(np.max([metrics.position_max_m for metrics in drives])),
                    float(np.mean([metrics.heading_rmse_rad for metrics in drives])),
                    float(np.mean([metrics.lateral_rmse_m for metrics in drives])),
                    int(np.sum([metrics.completed for metrics in drives])),
                    len(drives),
                )
            )
    return rows


def tracking_table(rows: Sequence[Tracking]) -> Table:
    """Tracking errors, a row for each controller and trajectory."""
    return Table(
        title="Closed loop on the identified robot",
        columns=(
            "controller",
            "trajectory",
            "position RMSE [m]",
            "position max [m]",
            "heading RMSE [rad]",
            "lateral RMSE [m]",
            "completed",
        ),
        rows=tuple(
            (
                row.controller,
                row.trajectory,
                f"{row.position_rmse:.4f}",
                f"{row.position_max:.4f}",
                f"{row.heading_rmse:.4f}",
                f"{row.lateral_rmse:.4f}",
                f"{row.completed}/{row.runs}",
            )
            for row in rows
        ),
        text_columns=2,
        note="The plant is the identified model with its base effects, so this shows that controller and model agree, "
        "and little about the real robot.",
    )
