"""Construction of plants by name."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.errors import checked_call, checked_number, wrong_type
from diffdrive_mpc.models.named_file import is_file
from diffdrive_mpc.models.robot import Robot, TwistBounds, load_robot
from diffdrive_mpc.models.two_sided import sides_of
from diffdrive_mpc.sim.disturbances.scenario import Scenario, combine, load_scenario
from diffdrive_mpc.sim.plants.disturbed_plant import DisturbedPlant
from diffdrive_mpc.sim.plants.names import DRAWN, MODEL, PHYSICS, split_plant
from diffdrive_mpc.sim.plants.plant import Plant
from diffdrive_mpc.sim.plants.plug_ins import Scene, make_part
from diffdrive_mpc.sim.plants.simulated_robot import DEFAULT, ROBOTS, SimulatedRobot, load_simulated_robot
from diffdrive_mpc.sim.plants.surface import Surface, load_surface
from diffdrive_mpc.sim.plants.twin_parameters import TwinParameters, load_twin_parameters
from diffdrive_mpc.sim.sensing.sensor_set import SensorSet, load_sensor_set

if TYPE_CHECKING:
    from diffdrive_mpc.models.nonlinear_model import NonlinearModel
    from diffdrive_mpc.models.velocity_model import VelocityModel
    from diffdrive_mpc.sim.plants.drawn_robot import DrawnRobot
    from diffdrive_mpc.sim.plants.identified_robot import IdentifiedRobot

_MODEL_PREFIX = f"{MODEL}:"
_MAX_PERIOD = 0.5
"""Maximum sample time, as in a configuration [s]."""
_IDENTIFIED_STREAM = 57
"""Key of the random stream of identified robots; the noise of the sensors uses another stream."""


@checked_call()
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
    readings: Mapping[str, Any] | None = None,
) -> Plant:
    """Build a plant.

    Parameters
    ----------
    name
        Name of the plant, or a velocity model.

        * "mujoco": robot of the papers in MuJoCo; "mujoco:NAME": a built-in robot or the path of a robot file.
        * "drawn:SEED": a robot of the market with its surface, slope, patches and motors.
        * "model:NAME": a velocity model with the base effects of its file; for NAME see `models.load_model`.
        * "model:NAME+SECONDS": a velocity model with additional dead time, for instance "model:sm+0.04". If
          NAME+SECONDS is the path of an existing file, the whole text is the name.
        * "model:FOLDER/robot.yaml": a robot file written by `identify`, with surface and sensors of the log; model
          and unexplained motion are drawn from `seed`.
        * "KIND:NAME", "KIND:NAME@PLANT": a plant of another package that extends one of the above plants, see
          `sim.plants.plug_ins`; for instance, "world:slalom@mujoco:heavy" adds obstacles around the robot "heavy".
    surface
        Name of a built-in surface or path of a surface file. The default surface of "mujoco:NAME" has the friction of
        the robot file if this file specifies a friction coefficient.
    sensors
        Name of a built-in sensor set or path of a sensor file; the default of "mujoco:NAME" is that of the robot file.
    seed
        Non-negative seed of the noise; runs with the same seed are bitwise equal.
    extra_dead_time
        Dead time of "model:" plants in addition to the dead times of the model and of `name` [s]. For "mujoco" plants,
        the robot file specifies the dead time.
    scenario
        Disturbances of the run: name of a built-in scenario or path of a scenario file. Random values are drawn from
        `seed` in a separate stream. "model:" plants support disturbances that do not need mass, wheels or motors.
    sample_time
        Duration of a command [s]; by default that of the robot. The physics uses shorter steps.
    limits
        Limits to which "model:" plants clip commands; by default those of the robot of the papers.
    scene
        Geometry around the robot; only for "mujoco" plants.
    readings
        Values that replace those of the default sensor set, see `bench.drive.sensor_readings`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a name is unknown, a file is invalid, or the arguments do not match.
    models.velocity_model.ModelError
        If a model with its dead time is invalid.
    models.errors.ArgumentError
        If an argument has a wrong type.
    models.errors.MissingPackageError
        If the package of a kind of plant or of a simulator part is not installed.
    """
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ConfigError(f"seed {seed!r}: give an integer that is not negative")
    if not isinstance(limits, (TwistBounds, type(None))):
        raise wrong_type("limits", "TwistBounds or None", limits, "give models.robot.TwistBounds(v=1.5, omega=2.0)")
    if sample_time is not None and not 0.0 < checked_number("sample_time", sample_time, "give seconds") <= _MAX_PERIOD:
        raise ConfigError(f"sample_time {sample_time!r} s: give a time above 0, at most {_MAX_PERIOD:g} s")
    model = None if isinstance(name, (str, Path)) else _checked_model(name)
    name = str(name) if model is None else f"{_MODEL_PREFIX}{model.name}"
    wrapped = split_plant(name)
    if wrapped is not None:
        kind, argument, plant = wrapped
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
            readings=readings,
        )
    drawn = drawn_robot(name)
    disturbances = load_scenario(scenario).draw(int(seed))
    if drawn is not None:
        disturbances = combine(disturbances, drawn.scenario)
    sensor_set = load_sensor_set(sensors, readings)
    setting = _Setting(name, surface, load_surface(surface), sensors, sensor_set, scenario, disturbances, int(seed))
    if drawn is not None or name == PHYSICS or name.startswith(f"{PHYSICS}:"):
        if extra_dead_time:
            raise ConfigError(
                "extra_dead_time is for 'model:' plants; 'mujoco:PATH' has twin.link.dead_time in its robot file"
            )
        return _physics_plant(setting, scene, sample_time)
    if name.startswith(_MODEL_PREFIX):
        if scene is not None:
            raise ConfigError(f"plant '{name}' has no body that can touch obstacles; use 'mujoco'")
        if not extra_dead_time >= 0:
            raise ConfigError(f"extra_dead_time {extra_dead_time} s: it must not be negative")
        return _model_plant(setting, model, extra_dead_time, model_robot(sample_time, limits))
    if is_file(name):
        kinds = f"'model:{name}' (a model, or robot.yaml of identify) or 'mujoco:{name}' (a simulated robot or twin)"
        raise ConfigError(f"plant '{name}': for a file give {kinds}")
    raise ConfigError(
        f"unknown plant '{name}': give 'mujoco', 'mujoco:NAME' (another robot, such as 'heavy', or the path of a robot "
        "file), 'drawn:SEED' (a robot of the market), 'model:NAME' (mbm, sm, ssm, a robot such as 'husky', or the "
        f"path of a model file) or, for additional dead time, 'model:NAME+SECONDS'{_suggest_plant(name)}"
    )


class _Setting(NamedTuple):
    """Arguments of a plant: names for messages and defaults, and the loaded objects."""

    name: str
    surface_name: str | Path
    surface: Surface
    sensors_name: str | Path
    sensors: SensorSet
    scenario_name: str | Path
    disturbances: Scenario
    seed: int


def _physics_plant(setting: _Setting, scene: Scene | None, sample_time: float | None) -> Plant:
    """Build a robot in MuJoCo with the scene and the disturbances of the setting."""
    surface, disturbances = setting.surface, setting.disturbances
    if surface.friction is None:
        raise ConfigError(
            f"surface '{setting.surface_name}' has no friction coefficient, which 'mujoco' plants need: use the "
            "surface with 'model:' plants"
        )
    from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant  # noqa: PLC0415 - needs MuJoCo

    build = simulated_robot(setting.name)
    sensors = build.sensors if build and setting.sensors_name == DEFAULT else setting.sensors
    values = build.parts if build else {}
    robot_friction = build.friction if build and setting.surface_name == DEFAULT else None
    robot = MujocoPlant(
        robot_friction or surface.friction,
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
    return DisturbedPlant(robot, disturbances, build.robot if build else load_robot(), lambda: robot.patch_spans)


def _model_plant(
    setting: _Setting, model: VelocityModel | NonlinearModel | None, extra_dead_time: float, robot: Robot
) -> Plant:
    """Build a plant with a velocity model: `model`, or the model in the name of the setting."""
    from diffdrive_mpc.models.load import load_base_effects, load_model  # noqa: PLC0415 - only this plant needs it
    from diffdrive_mpc.sim.plants.model_plant import ModelPlant  # noqa: PLC0415

    effects, slip, sensors, disturbance = BaseEffects(), setting.surface.slip, setting.sensors, None
    if model is None:
        file, name_dead_time = _split_dead_time(setting.name.removeprefix(_MODEL_PREFIX))
        extra_dead_time += name_dead_time
        identified = identified_robot_of(setting.name)
        if identified is not None:
            # Explicit arguments replace the surface and the sensors of the log.
            rng = np.random.default_rng([setting.seed, _IDENTIFIED_STREAM])
            file = str(Path(file).parent / identified.model)
            slip = identified.slip if setting.surface_name == DEFAULT else slip
            sensors = identified.sensors if setting.sensors_name == DEFAULT else sensors
            model = identified.draw_model(load_model(file), rng)
            disturbance = identified.disturbance(robot.sample_time, rng)
        effects, model = load_base_effects(file), model or load_model(file)
    disturbances = setting.disturbances
    if disturbances.physical:
        raise ConfigError(
            f"scenario '{setting.scenario_name}' needs a plant with mass, wheels and motors "
            f"({', '.join(disturbances.physical)}), unlike '{setting.name}'; use 'mujoco'"
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


def _suggest_plant(name: str) -> str:
    """Format a similar name as a suggestion for the message about an unknown plant; empty if no name is similar."""
    from diffdrive_mpc.models.load import ROBOT_NAMES, model_names  # noqa: PLC0415 - see make_plant

    names = {PHYSICS: PHYSICS, DRAWN: f"{DRAWN}:SEED"} | {robot: f"{PHYSICS}:{robot}" for robot in ROBOTS.names}
    names |= {model: _MODEL_PREFIX + model for model in (*model_names(), *ROBOT_NAMES)}
    if is_file(robot := Path(name) / "robot.yaml"):
        return f"; did you mean '{_MODEL_PREFIX}{robot}'?"
    similar = difflib.get_close_matches(name.lower(), names, n=1)
    return f"; did you mean '{names[similar[0]]}'?" if similar else ""


def plant_body(name: str) -> tuple[Robot, TwinParameters]:
    """Return robot and physical parameters of the plant `name`; for "model:NAME", return those of the papers' robot.

    Raises ConfigError if the robot file is invalid.
    """
    build = simulated_robot(plant_inside(name))
    return (build.robot, build.twin) if build else (load_robot(), load_twin_parameters())


def _checked_model(model: object) -> VelocityModel | NonlinearModel:
    """Return `model`; raise ArgumentError if it is not a velocity model."""
    from diffdrive_mpc.models.nonlinear_model import NonlinearModel  # noqa: PLC0415 - needs CasADi
    from diffdrive_mpc.models.velocity_model import VelocityModel  # noqa: PLC0415

    if not isinstance(model, (VelocityModel, NonlinearModel)):
        raise wrong_type("plant", "a name or a velocity model", model, "give a name such as 'mujoco'")
    return model


def physics_robot(name: str) -> Robot | None:
    """Return the robot of a "mujoco" or "drawn" plant; None for "model:NAME".

    Raises ConfigError if the robot file is invalid.
    """
    is_physics = plant_inside(name).partition(":")[0] in (PHYSICS, DRAWN)
    return plant_body(name)[0] if is_physics else None


def plant_inside(name: str) -> str:
    """Return PLANT of "KIND:NAME@PLANT", and other names unchanged; for errors see `split_plant`."""
    wrapped = split_plant(name)
    return name if wrapped is None else wrapped[2]


@lru_cache(maxsize=16)
def drawn_robot(name: str) -> DrawnRobot | None:
    """Return the robot of a plant "drawn:SEED", None for other plants; raise ConfigError for an invalid seed."""
    kind, colon, seed = plant_inside(name).partition(":")
    if not colon or kind != DRAWN:
        return None
    if not seed.isdecimal():
        raise ConfigError(f"plant '{name}': give {DRAWN}:SEED with an integer that is not negative")
    from diffdrive_mpc.sim.plants.drawn_robot import draw_robot  # noqa: PLC0415 - most plants are not drawn

    return draw_robot(int(seed))


def simulated_robot(name: str) -> SimulatedRobot | None:
    """Return the robot of the plant "mujoco:NAME" or "drawn:SEED"; None for other plants.

    Raises ConfigError if the robot file is invalid.
    """
    drawn = drawn_robot(name)
    if drawn is not None:
        return drawn.build
    kind, colon, file = name.partition(":")
    return load_simulated_robot(file) if colon and kind == PHYSICS else None


def model_robot(sample_time: float | None, limits: TwistBounds | None) -> Robot:
    """Return the robot of the papers with a sample time [s] and limits; None keeps the value."""
    robot = load_robot()
    # The link has symmetric limits, so the larger limit of both directions is used.
    symmetric = {} if limits is None else {"v": max(sides_of(limits.v)), "omega": max(sides_of(limits.omega))}
    bounds = robot.limits.model_copy(update=symmetric)
    return robot.model_copy(update={"sample_time": sample_time or robot.sample_time, "limits": bounds})


def identified_robot_of(plant: str) -> IdentifiedRobot | None:
    """Load the robot of a plant "model:FILE" or "model:FILE+SECONDS"; return None for a plant of another kind.

    Raises the errors of `load_identified_robot`, and ConfigError for an invalid dead time.
    """
    from diffdrive_mpc.sim.plants.identified_robot import load_identified_robot  # noqa: PLC0415

    is_model = plant.startswith(_MODEL_PREFIX)
    return load_identified_robot(_split_dead_time(plant.removeprefix(_MODEL_PREFIX))[0]) if is_model else None


def _split_dead_time(text: str) -> tuple[str, float]:
    """Split NAME or NAME+SECONDS into model and extra dead time [s]; the path of a file may contain a plus sign."""
    model, plus, seconds = text.rpartition("+")
    if not plus or is_file(text):
        return text, 0.0
    try:
        dead_time = float(seconds)
    except ValueError:
        dead_time = math.nan
    if not (math.isfinite(dead_time) and dead_time >= 0):
        raise ConfigError(
            f"plant 'model:{text}': '{seconds}' is not a dead time; write model:NAME+SECONDS, such as model:sm+0.04, "
            "or the path of an existing model file"
        )
    return model, dead_time
