"""Plants by name."""

from __future__ import annotations

import difflib
import math
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.errors import wrong_type
from diffdrive_mpc.models.named_file import is_file
from diffdrive_mpc.models.robot import Robot, TwistBounds, load_robot
from diffdrive_mpc.models.two_sided import sides_of
from diffdrive_mpc.sim.disturbances.scenario import Scenario, combine, load_scenario
from diffdrive_mpc.sim.plants.disturbed_plant import DisturbedPlant
from diffdrive_mpc.sim.plants.names import DRAWN, MODEL, PHYSICS, split_plant
from diffdrive_mpc.sim.plants.plant import Plant
from diffdrive_mpc.sim.plants.plug_ins import Scene, make_part
from diffdrive_mpc.sim.plants.simulated_robot import DEFAULT, SimulatedRobot, load_simulated_robot
from diffdrive_mpc.sim.plants.surface import Surface, load_surface
from diffdrive_mpc.sim.plants.twin_parameters import TwinParameters, load_twin_parameters
from diffdrive_mpc.sim.sensing.sensor_set import SensorSet, load_sensor_set

if TYPE_CHECKING:
    from diffdrive_mpc.models.nonlinear_model import NonlinearModel
    from diffdrive_mpc.models.velocity_model import VelocityModel
    from diffdrive_mpc.sim.plants.drawn_robot import DrawnRobot

_MODEL_PREFIX = f"{MODEL}:"
_IDENTIFIED = 57
"""Stream of the generator of identified robots, apart from the noise of the same seed."""


def make_plant(
    name: str | Path | VelocityModel | NonlinearModel,
    surface: str | Path = "default",
    sensors: str | Path = "default",
    seed: int = 0,
    *,
    extra_dead_time: float = 0.0,
    scenario: str | Path = "none",
    sample_time: float | None = None,
    limits: TwistBounds | None = None,
    scene: Scene | None = None,
) -> Plant:
    """Build a plant.

    Parameters
    ----------
    name
        "mujoco" for the physics, "mujoco:NAME" for another robot in it, NAME shipped or the path of a robot file, or
        "model:NAME" for a velocity model with the base effects of its file, NAME as `models.load_model` takes it.
        "drawn:SEED" is a robot of the market on a floor of its own, which brings its slope, patches and motors along.
        "model:NAME+SECONDS" puts that dead time on top of the model's own, as `extra_dead_time` does: "model:sm+0.04".
        Where a file has the whole of NAME+SECONDS for a path, it is that file. Or a velocity model itself.
        "model:FOLDER/robot.yaml" is the robot that `identify` wrote: model and unexplained motion are drawn by `seed`,
        surface and sensors are those of the log.
        "KIND:NAME" and "KIND:NAME@PLANT" are plants of other packages around one of these, see `sim.plants.plug_ins`:
        "world:slalom" has obstacles, "world:slalom@mujoco:heavy" has them around another robot.
    surface
        Name of a shipped surface or path of a surface file. For "mujoco:NAME" the default one has the friction that the
        robot file says, where it says one.
    sensors
        Name of a shipped sensor set or path of a sensor file; the default ones of "mujoco:NAME" are those of its file.
    seed
        Seed of all noise, not negative: the same seed gives the same run, bit for bit.
    extra_dead_time
        For "model:" plants: dead time on top of the model's own and of that in `name` [s]. The physics has its own in
        its parameter file.
    scenario
        Name of a shipped scenario or path of a scenario file: what happens to the robot during a run. Its random values
        are drawn from `seed`, in a separate stream. "model:" plants take those without mass, wheels and motors.
    sample_time
        Time for which a command holds [s]; by default that of the robot. The physics has its own steps.
    limits
        For "model:" plants: commands beyond this are cut off; by default as the link of the robot of the papers does.
    scene
        Geometry around the robot, for the physics only.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a name is unknown, a file has a mistake, or the arguments do not go together.
    models.velocity_model.ModelError
        If a model cannot be a robot's, its dead time included.
    models.errors.ArgumentError
        If an argument has another type.
    models.errors.MissingPackageError
        If the package of a kind of plants or of a simulator part is not installed.
    """
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ConfigError(f"seed {seed!r}: give an integer that is not negative")
    model = None if isinstance(name, (str, Path)) else _checked_model(name)
    name = str(name) if model is None else f"{_MODEL_PREFIX}{model.name}"
    around = split_plant(name)
    if around is not None:
        kind, argument, plant = around
        return kind.make_plant(
            argument,
            plant,
            surface=surface,
            sensors=sensors,
            seed=int(seed),
            extra_dead_time=extra_dead_time,
            scenario=scenario,
            sample_time=sample_time,
            limits=limits,
        )
    drawn = drawn_robot(name)
    disturbances = load_scenario(scenario).draw(int(seed))
    if drawn is not None:
        disturbances = combine(disturbances, drawn.scenario)
    setting = _Setting(
        name, surface, load_surface(surface), sensors, load_sensor_set(sensors), scenario, disturbances, int(seed)
    )
    if drawn is not None or name == PHYSICS or name.startswith(f"{PHYSICS}:"):
        if extra_dead_time:
            raise ConfigError(
                "extra_dead_time is for 'model:' plants; 'mujoco:PATH' has twin.link.dead_time in its robot file"
            )
        return _physics_plant(setting, scene, sample_time)
    if name.startswith(_MODEL_PREFIX):
        if scene is not None:
            raise ConfigError(f"plant '{name}' has no body that obstacles could touch; use 'mujoco'")
        if not extra_dead_time >= 0:
            raise ConfigError(f"extra_dead_time {extra_dead_time} s: it must not be negative")
        return _model_plant(setting, model, extra_dead_time, _model_robot(sample_time, limits))
    raise ConfigError(
        f"unknown plant '{name}': give 'mujoco', 'mujoco:NAME' (another robot, such as 'heavy', or the path of a robot "
        "file), 'drawn:SEED' (a robot of the market) or 'model:NAME' (mbm, sm, ssm, a robot such as 'husky', or the "
        f"path of a model file), with more dead time 'model:NAME+SECONDS'{_near_plant(name)}"
    )


class _Setting(NamedTuple):
    """Setting of a plant: names as given, for messages and defaults, with their objects."""

    name: str
    surface_name: str | Path
    surface: Surface
    sensors_name: str | Path
    sensors: SensorSet
    scenario_name: str | Path
    disturbances: Scenario
    seed: int


def _physics_plant(setting: _Setting, scene: Scene | None, sample_time: float | None) -> Plant:
    """Make a robot in MuJoCo, with the disturbances of the setting and the scene around it."""
    surface, disturbances = setting.surface, setting.disturbances
    if surface.friction is None:
        raise ConfigError(
            f"surface '{setting.surface_name}' has no friction: it is for 'model:' plants; wheels need it to push"
        )
    from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant  # noqa: PLC0415 - needs MuJoCo

    build = simulated_robot(setting.name)
    sensors = build.sensors if build and setting.sensors_name == DEFAULT else setting.sensors
    values = build.parts if build else {}
    own_friction = build.friction if build and setting.surface_name == DEFAULT else None
    robot = MujocoPlant(
        own_friction or surface.friction,
        sensors,
        setting.seed,
        robot=build.robot if build else None,
        twin=build.twin if build else None,
        firmware=build.firmware if build else None,
        base=build.base if build else None,
        scenario=disturbances if disturbances.physical else None,
        sideways=surface.sideways,
        sample_time=sample_time,
        scene=scene,
        parts={name: make_part(name, part, values.get(name, {}), setting.seed) for name, part in sensors.parts.items()},
    )
    if not disturbances.kinds:
        return robot
    return DisturbedPlant(robot, disturbances, build.robot if build else load_robot(), lambda: robot.crossed)


def _model_plant(
    setting: _Setting, model: VelocityModel | NonlinearModel | None, extra_dead_time: float, robot: Robot
) -> Plant:
    """Build a robot that moves as a velocity model: `model`, or the one in the setting's name."""
    from diffdrive_mpc.models.load import load_base_effects, load_model  # noqa: PLC0415 - only this plant needs it
    from diffdrive_mpc.sim.plants.identified_robot import load_identified_robot  # noqa: PLC0415
    from diffdrive_mpc.sim.plants.model_plant import ModelPlant  # noqa: PLC0415

    effects, slip, sensors, disturbance = BaseEffects(), setting.surface.slip, setting.sensors, None
    if model is None:
        file, named_dead_time = _split(setting.name.removeprefix(_MODEL_PREFIX))
        extra_dead_time += named_dead_time
        identified = load_identified_robot(file)
        if identified is not None:
            rng, file = np.random.default_rng([setting.seed, _IDENTIFIED]), str(Path(file).parent / identified.model)
            slip = identified.slip if setting.surface_name == DEFAULT else slip
            sensors = identified.sensors if setting.sensors_name == DEFAULT else sensors
            model = identified.drawn_model(load_model(file), rng)
            disturbance = identified.disturbance(robot.sample_time, rng)
        effects, model = load_base_effects(file), model or load_model(file)
    disturbances = setting.disturbances
    if disturbances.physical:
        raise ConfigError(
            f"scenario '{setting.scenario_name}' needs a plant with mass, wheels and motors "
            f"({', '.join(disturbances.physical)}): '{setting.name}' has none; use 'mujoco'"
        )
    plant = ModelPlant(
        model,
        slip,
        sensors,
        setting.seed,
        extra_dead_time=extra_dead_time,
        effects=effects,
        robot=robot,
        disturbance=disturbance,
    )
    return DisturbedPlant(plant, disturbances, load_robot()) if disturbances.kinds else plant


def _near_plant(name: str) -> str:
    """Format the end of the message about an unknown plant: the nearest name, if one is near."""
    from diffdrive_mpc.models.load import model_names  # noqa: PLC0415 - see make_plant

    by_words = {PHYSICS: PHYSICS, DRAWN: f"{DRAWN}:SEED"} | {model: _MODEL_PREFIX + model for model in model_names()}
    near = difflib.get_close_matches(name.lower(), by_words, n=1)
    return f"; did you mean '{by_words[near[0]]}'?" if near else ""


def plant_body(name: str) -> tuple[Robot, TwinParameters]:
    """Return the robot of a plant's name and its physical parameters; those of the papers for "model:NAME".

    Raises ConfigError if it names a robot file that cannot be used.
    """
    build = simulated_robot(plant_inside(name))
    return (build.robot, build.twin) if build else (load_robot(), load_twin_parameters())


def _checked_model(model: object) -> VelocityModel | NonlinearModel:
    """Return `model`; raise ArgumentError if it is none."""
    from diffdrive_mpc.models.nonlinear_model import NonlinearModel  # noqa: PLC0415 - needs CasADi
    from diffdrive_mpc.models.velocity_model import VelocityModel  # noqa: PLC0415

    if not isinstance(model, (VelocityModel, NonlinearModel)):
        raise wrong_type("plant", "a name or a velocity model", model, "make it with make_plant('mujoco')")
    return model


def physics_robot(name: str) -> Robot | None:
    """Return geometry and limits of the robot of a plant in the physics; None for "model:NAME".

    Raises ConfigError where a robot file is named that cannot be used.
    """
    name = plant_inside(name)
    if name.partition(":")[0] not in (PHYSICS, DRAWN):
        return None
    build = simulated_robot(name)
    return build.robot if build else load_robot()


def plant_inside(name: str) -> str:
    """Return PLANT of "KIND:NAME@PLANT"; other names unchanged. Raises MissingPackageError as `split_plant`."""
    around = split_plant(name)
    return name if around is None else around[2]


@lru_cache(maxsize=16)
def drawn_robot(name: str) -> DrawnRobot | None:
    """Return the robot of the market in a plant; None for other plants. Raises ConfigError without a seed."""
    kind, colon, seed = plant_inside(name).partition(":")
    if not colon or kind != DRAWN:
        return None
    if not seed.isdecimal():
        raise ConfigError(f"plant '{name}': give {DRAWN}:SEED with an integer that is not negative")
    from diffdrive_mpc.sim.plants.drawn_robot import draw_robot  # noqa: PLC0415 - most plants are not drawn

    return draw_robot(int(seed))


def simulated_robot(name: str) -> SimulatedRobot | None:
    """Return the robot of the plant "mujoco:NAME" or "drawn:SEED"; None for other plants.

    Raises ConfigError if its file has a mistake.
    """
    drawn = drawn_robot(name)
    if drawn is not None:
        return drawn.build
    kind, colon, file = name.partition(":")
    return load_simulated_robot(file) if colon and kind == PHYSICS else None


def _model_robot(sample_time: float | None, limits: TwistBounds | None) -> Robot:
    robot = load_robot()
    # The link cuts off at one number for both sides.
    cut = {} if limits is None else {"v": max(sides_of(limits.v)), "omega": max(sides_of(limits.omega))}
    bounds = robot.limits.model_copy(update=cut)
    return robot.model_copy(update={"sample_time": sample_time or robot.sample_time, "limits": bounds})


def _split(text: str) -> tuple[str, float]:
    """Model and extra dead time [s] of NAME or NAME+SECONDS; an existing file may have a plus in its path."""
    model, plus, seconds = text.rpartition("+")
    if not plus or is_file(text):
        return text, 0.0
    try:
        dead_time = float(seconds)
    except ValueError:
        dead_time = math.nan
    if not (math.isfinite(dead_time) and dead_time >= 0):
        raise ConfigError(
            f"plant 'model:{text}': '{seconds}' is no dead time; write model:NAME+SECONDS, such as model:sm+0.04, or "
            "the path of a model file that exists"
        )
    return model, dead_time
