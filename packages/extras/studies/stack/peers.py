"""Drives of our peers `rpp` and `mppi` with the parameters that a log tells for Nav2, beside their defaults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from diffdrive_mpc.bench.peers import make_peer
from diffdrive_mpc.bench.peers.tracking_peer import MODEL, load_gains, make_tracking_peer
from diffdrive_mpc.bench.statistics import BootstrapEstimate
from diffdrive_mpc.bench.table import Table, millis, number
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.identification.log_data import LogData
from diffdrive_mpc.models.identification.stack import Quantities, estimate_stack
from diffdrive_mpc.models.interface import FloatArray, TrackingController
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.velocity_model import CHANNELS
from diffdrive_mpc.mpc import Controller, ControllerConfig, load_config, load_trajectory
from diffdrive_mpc.sim import make_plant, simulate
from diffdrive_mpc.sim.plants.open_loop import drive_open_loop, random_commands
from diffdrive_mpc_extras.peers.rpp import RegulatedPurePursuit, load_parameters

PEERS = {"rpp": "lateral_rmse_m", "mppi": "position_rmse_m"}
"""Peers with their error: `rpp` follows a path without times, so that only its distance from the path counts."""
VARIANTS = ("default", "identified")
PURSUIT = {
    "lookahead_time": "look_ahead_time",
    "min_lookahead_dist": "min_look_ahead",
    "max_lookahead_dist": "max_look_ahead",
    "lookahead_dist": "look_ahead",
    "max_angular_accel": "rate.omega",
}
"""Parameters of `rpp` by their names in Nav2, with what `identify --for nav2` writes there (`estimate_stack`)."""
LIMITS = {"v": "max.v", "omega": "max.omega", "v_slew": "rate.v", "omega_slew": "rate.omega"}
"""Limits of the command of both peers, in the place of Nav2's velocity smoother."""


class RecordedLog(StrictModel):
    """The log that parameters are identified from."""

    seconds: float
    seed: int


class PeerDrives(StrictModel):
    """What is driven; units in `peers.yaml`."""

    robots: tuple[str, ...]
    trajectories: tuple[str, ...]
    seeds: Annotated[tuple[int, ...], Field(min_length=2)]
    log: RecordedLog


def load_peer_drives(path: Path | None = None) -> PeerDrives:
    """Read what is driven; raises ConfigError on a mistake in it."""
    return load_checked(PeerDrives, path or Path(__file__).with_name("peers.yaml"))


@dataclass(frozen=True)
class PeerDrive:
    """One drive: `quantities` are those of the robot's log, None for the peer's defaults."""

    robot: str
    peer: str
    trajectory: str
    seed: int
    quantities: Quantities | None


def identified(robot: str, drives: PeerDrives) -> Quantities:
    """What the log of random set-points in open loop tells of a robot, by the names of `estimate_stack`."""
    plant = make_plant(robot, seed=drives.log.seed)
    dt = plant.sample_time
    commands = random_commands(drives.log.seed, smooth=False, duration=drives.log.seconds, sample_time=dt)
    log = drive_open_loop(plant, commands)
    record = Record(robot, 0.0, dt, log.command, twist=log.wheel_twist, yaw_rate=log.yaw_rate)
    return estimate_stack(LogData((record,), (), (robot,), "nothing", "gyro", (), ()))


def known(names: Mapping[str, str], quantities: Quantities) -> dict[str, float]:
    """Values of the parameters that the log tells; the others keep their defaults."""
    values = {name: quantities[quantity].value for name, quantity in names.items()}
    return {name: value for name, value in values.items() if value is not None}


def limited(quantities: Quantities) -> ControllerConfig:
    """The configuration of the peers with the limits that the log tells."""
    return load_config(MODEL, {f"limits.{name}": value for name, value in known(LIMITS, quantities).items()})


def later(quantities: Quantities) -> FloatArray:
    """(2,) by how much the robot answers later than the model of the peers [s]; 0 where the log does not tell it."""
    usual = Controller(load_config(MODEL)).model.lag
    delays = known({name: f"delay.{name}" for name in CHANNELS}, quantities)
    return np.array([delays.get(name, lag) - lag for name, lag in zip(CHANNELS, usual, strict=True)])


def make_rpp(quantities: Quantities) -> TrackingController:
    """Regulated pure pursuit with the look-ahead that the delay asks for."""
    changes: dict[str, object] = {"use_velocity_scaled_lookahead_dist": True, **known(PURSUIT, quantities)}
    return RegulatedPurePursuit(limited(quantities), load_parameters().model_copy(update=changes))


def make_mppi(quantities: Quantities) -> TrackingController:
    """Our `mppi` with `model_delay_vx` and `model_delay_wz`: what is beyond its own lag is dead time.

    The estimate, the prediction and the feed-forward know that dead time for each channel; the law acts on the pose
    that is the mean of both further ahead.
    """
    config, delay = limited(quantities), later(quantities)
    dead_times = np.maximum(0.0, [config.extra_dead_time.v, config.extra_dead_time.omega] + delay)
    extra = config.extra_dead_time.model_copy(update=dict(zip(CHANNELS, dead_times.tolist(), strict=True)))
    gains = load_gains("mppi")
    gains = gains.model_copy(update={"lead": max(0.0, gains.lead + float(np.mean(delay)))})
    return make_tracking_peer("mppi", gains, config.model_copy(update={"extra_dead_time": extra}))


def driven(drive: PeerDrive) -> dict[str, object]:
    """The row of a drive."""
    make = {"rpp": make_rpp, "mppi": make_mppi}[drive.peer]
    peer = make_peer(drive.peer) if drive.quantities is None else make(drive.quantities)
    run = simulate(peer, make_plant(drive.robot, seed=drive.seed), load_trajectory(drive.trajectory))
    return {
        "robot": drive.robot,
        "peer": drive.peer,
        "trajectory": drive.trajectory,
        "seed": drive.seed,
        "variant": VARIANTS[drive.quantities is not None],
        "error_m": getattr(run.metrics, PEERS[drive.peer]),
        "ended": run.ended,
    }


def all_drives(drives: PeerDrives, logs: Mapping[str, Quantities]) -> list[PeerDrive]:
    """Every robot, peer, path, seed and variant; the slow peer first."""
    return [
        PeerDrive(robot, peer, trajectory, seed, quantities)
        for peer in reversed(PEERS)
        for robot, from_log in logs.items()
        for trajectory in drives.trajectories
        for seed in drives.seeds
        for quantities in (None, from_log)
    ]


def error_table(rows: Sequence[Mapping[str, object]], drives: PeerDrives) -> Table:
    """Errors with defaults and with identified parameters, and their ratio with its paired bootstrap interval."""
    errors = {
        tuple(row[name] for name in ("robot", "peer", "variant", "trajectory", "seed")): float(str(row["error_m"]))
        for row in rows
    }
    lines = []
    for robot in drives.robots:
        for peer in PEERS:
            default, identified = (
                np.array(
                    [
                        [errors[robot, peer, variant, path, seed] for seed in drives.seeds]
                        for path in drives.trajectories
                    ]
                )
                for variant in VARIANTS
            )
            paths = [slice(k, k + 1) for k in range(len(drives.trajectories))]
            for path, part in zip((*drives.trajectories, "all"), (*paths, slice(None)), strict=True):
                ratio = BootstrapEstimate.of_same_runs((default[part], identified[part]), _ratio)
                cells = (millis(float(default[part].mean())), millis(float(identified[part].mean())))
                interval = f"[{number(ratio.low, 2)}, {number(ratio.high, 2)}]"
                lines.append((robot, peer, path, *cells, f"{number(ratio.value, 2)} {interval}"))
    columns = ("robot", "peer", "path", "default [mm]", "identified [mm]", "identified over default")
    ended = sum(bool(row["ended"]) for row in rows)
    note = (
        f"Means over {len(drives.seeds)} seeds: for rpp RMSE of the distance from the path, for mppi of the position. "
        f"Intervals: 95 %, paired bootstrap over the seeds, with one log for each robot. "
        f"{ended} of {len(rows)} drives were ended early."
    )
    return Table("Peers with identified parameters", columns, tuple(lines), text_columns=3, note=note)


def _ratio(default: FloatArray, identified: FloatArray) -> FloatArray:
    """Of tables (..., paths, seeds), where seeds are drawn along the last axis."""
    return np.asarray(identified.mean(axis=(0, -1)) / default.mean(axis=(0, -1)))


def parameter_table(logs: Mapping[str, Quantities]) -> Table:
    """What the log of each robot tells, with its interval, beside what the peers have without it."""
    config, parameters = load_config(MODEL), load_parameters()
    names = {f"rpp: {name}": (quantity, getattr(parameters, name)) for name, quantity in PURSUIT.items()}
    lag = Controller(config).model.lag.tolist()
    names |= {f"mppi: model_delay.{c}": (f"delay.{c}", usual) for c, usual in zip(CHANNELS, lag, strict=True)}
    names |= {f"limits.{name}": (quantity, getattr(config.limits, name)) for name, quantity in LIMITS.items()}
    lines = []
    for robot, quantities in logs.items():
        for name, (quantity, usual) in names.items():
            part = quantities[quantity]
            value = "not known" if part.value is None else number(part.value, 3)
            interval = "-" if part.value is None else f"[{number(part.interval[0], 3)}, {number(part.interval[1], 3)}]"
            lines.append((robot, name, number(float(usual), 3), value, interval))
    columns = ("robot", "parameter", "default", "identified", "interval")
    note = (
        "SI units; intervals of 95 %. What is not known keeps its default. The delay of a default is the model's lag."
    )
    return Table("Parameters of the peers", columns, tuple(lines), text_columns=2, note=note)
