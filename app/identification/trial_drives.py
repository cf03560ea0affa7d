"""Does the configuration drive? Paths scaled to the robot, on the identified model and on one of the held-out part."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.checked_yaml import check
from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.identification import Identification
from diffdrive_mpc.models.identification.fitting import fit
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.models.table import Table, number
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc import Controller, ControllerConfig
from diffdrive_mpc.mpc.trajectories.scaled import scaled_to_robot
from diffdrive_mpc.sim import Metrics, Run, simulate
from diffdrive_mpc.sim.plants.model_plant import ModelPlant
from diffdrive_mpc.sim.plants.surface import Surface
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set

PATHS = ("circle", "square", "s", "cane")
ITSELF, HELD_OUT = "the model itself", "a model of the data held out"
_TITLE = "Driving with it"
_FAR = 0.05
"""Share of the turning circle beside the path from which a drive is warned of [-]."""
_NOTE = (
    "Paths scaled to size and limits of the robot. Its turning circle is that at its limits: below 5 % is "
    "good. On the model itself this shows that configuration and model agree; on one of the data held out, that it "
    "does not depend on the part of the log. Neither shows the floor: begin slowly, with room."
)


@dataclass(frozen=True)
class TrialDrive:
    """One path on one stand-in of the robot.

    Attributes
    ----------
    plant
        `ITSELF` or `HELD_OUT`.
    path
        Which.
    run
        What happened.
    turning_circle
        Diameter of the circle that the robot drives at its limits of v and omega [m].
    """

    plant: str
    path: str
    run: Run
    turning_circle: float

    @property
    def metrics(self) -> Metrics:
        """Statistics of the run."""
        return self.run.metrics

    @property
    def lateral_share(self) -> float:
        """Largest lateral error over the turning circle [-]."""
        return self.metrics.lateral_max_m / self.turning_circle


def trial_drives(
    found: Identification, config: ControllerConfig, on_run: Callable[[], None] = lambda: None
) -> list[TrialDrive]:
    """Drive `PATHS` with the configuration on stand-ins of the robot; `on_run` is called after each.

    Where the held-out part allows no model of its own there is no stand-in of it.
    """
    gain = np.abs(np.diag(found.model.dc_gain))
    circle = 2 * gain[0] * config.limits.v / (gain[1] * config.limits.omega)
    effects = _effects_of(found.report.fitted.identified)
    plants: list[tuple[str, VelocityModel | NonlinearModel, BaseEffects]] = [(ITSELF, found.model, effects)]
    other = _of_held_out(found)
    if other is not None:
        plants.append((HELD_OUT, *other))
    slip, usual = check(Surface, found.surface, "surface").slip, load_robot()
    limits = usual.limits.model_copy(update={"v": config.limits.v, "omega": config.limits.omega})
    robot = usual.model_copy(update={"sample_time": config.sample_time, "limits": limits})
    drives = []
    for name, model, around in plants:
        for path in PATHS:
            plant = ModelPlant(model, slip, load_sensor_set("default"), effects=around, robot=robot)
            reference = scaled_to_robot(path, config, found.model)
            drives.append(TrialDrive(name, path, simulate(Controller(config), plant, reference), circle))
            on_run()
    return drives


def _effects_of(identified: IdentifiedModel) -> BaseEffects:
    return BaseEffects.model_validate(identified.content.get("base_effects", {}))


def _of_held_out(found: Identification) -> tuple[VelocityModel | NonlinearModel, BaseEffects] | None:
    """An SM of the records held out, with the effects that were found, as those records have them; or a drive of them.

    A plain SM would take a slope that the base limits for a lag that it does not have.
    """
    data, base, predictor = found.report.data, found.report.fitted.base, found.report.fitted.predictor
    try:
        own = predictor.refitted(data.validation, data.yaw) if predictor else None
        if own is not None:
            return own, BaseEffects()
        if base is not None:
            other = base.refitted(data.validation)
        else:
            other = fit(replace(data, train=data.validation, validation=data.train), STRUCTURES["sm"]).identified
        return other.model, _effects_of(other)
    except ValueError:
        return None


def trial_table(drives: Sequence[TrialDrive]) -> Table:
    """Errors, a row for each stand-in and path."""
    columns = ("stand-in", "path", "position RMSE [m]", "largest lateral [m]", "of the turning circle [%]")
    return Table(
        _TITLE,
        (*columns, "fall-backs", "completed"),
        tuple(
            (
                drive.plant,
                drive.path,
                number(drive.metrics.position_rmse_m, 4),
                number(drive.metrics.lateral_max_m, 4),
                number(100 * drive.lateral_share, 1),
                str(drive.metrics.fallbacks),
                "yes" if drive.metrics.completed else "no",
            )
            for drive in drives
        ),
        text_columns=2,
        note=_NOTE,
    )


def trial_doubts(drives: Sequence[TrialDrive]) -> list[Doubt]:
    """A doubt for each drive that failed."""
    found = [
        f"the configuration does not drive '{drive.path}' on {drive.plant}: "
        + (
            f"{100 * drive.lateral_share:.0f} % of its turning circle beside the path"
            if drive.metrics.completed
            else "it did not arrive"
        )
        for drive in drives
        if not drive.metrics.completed or drive.lateral_share > _FAR
    ]
    return [Doubt("failed drive", words) for words in found]
