"""Chassis in MuJoCo: a rigid body with four wheels that roll and skid on a flat surface."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import Robot
from diffdrive_mpc.sim.core.library import address, load_twin, physics_step
from diffdrive_mpc.sim.disturbances.disturbance_types import Payload, Slope
from diffdrive_mpc.sim.plants.drivetrain import checked_pose
from diffdrive_mpc.sim.plants.plant import RobotLostError
from diffdrive_mpc.sim.plants.plug_ins import Scene
from diffdrive_mpc.sim.plants.twin_parameters import TwinParameters, Tyre

_MAX_TILT = math.pi / 4
"""Tilt above which a robot counts as tipped over [rad]."""

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
_SETTLING_TIME = 1.0
"""Simulated time in which the robot settles on its soft tyres [s]."""
_CASTOR = 0.01
"""Assumed ratio of the friction of a castor, including swivel and bearing, to that of a wheel [-]."""
_CAPSULE = 1e-4
"""Half length of a capsule wheel [m], so short that its two contact points act like a single point."""


class Chassis:
    """Free rigid body with four hinged wheels and one contact point per wheel.

    The contact geometry of a wheel is a sphere, with a smooth contact point in the middle of the tyre. If the friction
    across the rolling direction differs from that along the rolling direction, wheels are very short capsules along the
    axle, since the contact frame of a capsule is aligned with the capsule.

    Parameters
    ----------
    robot, twin
        Geometry, masses and tyres.
    friction
        Sliding friction coefficient.
    step
        Physics step [s].
    payload
        Load on the body; None if there is no load.
    slope
        Tilt of the surface, whose plane contains positions and headings; None for a horizontal surface.
    sideways
        Ratio of sliding friction across to sliding friction along the rolling direction [-].
    scene
        Geometry around the robot; None if there is only the surface.
    """

    def __init__(
        self,
        robot: Robot,
        twin: TwinParameters,
        friction: float,
        step: float,
        payload: Payload | None = None,
        slope: Slope | None = None,
        sideways: float = 1.0,
        scene: Scene | None = None,
    ) -> None:
        import mujoco  # noqa: PLC0415 - an optional dependency of this plant

        # Without a handler, MuJoCo writes warnings to a log file in the working directory. `step` reports divergence.
        mujoco.set_mju_user_warning(lambda _warning: None)
        self._forward = mujoco.mj_forward
        self._restart = mujoco.mj_resetData
        self._scene = scene
        xml = _mjcf(robot, twin, step, payload, sideways != 1.0, scene)
        self._model: Any = mujoco.MjModel.from_xml_string(xml)
        self._data: Any = mujoco.MjData(self._model)
        # MuJoCo requires positive friction, so castors have a negligible friction instead of zero.
        self._friction_scale = np.array([1.0, 1.0, _CASTOR, _CASTOR]) if twin.chassis.castors else np.ones(4)
        self._sideways = sideways
        self.set_friction(np.full(4, friction))
        self._position, self._velocity = self._data.qpos, self._data.qvel
        # Positions 0 to 6 and velocities 0 to 5 belong to the free joint of the body, and the following to the wheels.
        ffi, self._lib = load_twin()
        self.c = ffi.new(
            "twin_chassis *",
            {
                "model": ffi.cast("void *", self._model._address),
                "data": ffi.cast("void *", self._data._address),
                "position": address(self._position),
                "velocity": address(self._velocity),
                "torque": address(self._data.qfrc_applied[6:10]),
                "max_state": mujoco.mjMAXVAL,
                "min_upright": math.cos(_MAX_TILT),
            },
        )
        self._step = _step_in_c(self._model, self._data, scene)
        self.c.step = self._step
        if scene is not None:
            scene.enter(self._model, self._data)
        # The tyres are soft, so the height at rest depends on the weight.
        mujoco.mj_step(self._model, self._data, nstep=round(_SETTLING_TIME / step))
        self._resting_height = float(self._position[2])
        if slope is not None:
            # The surface is tilted after settling, since no motors hold the robot while it settles.
            self._model.opt.gravity[:] = _tilted_gravity(self._model.opt.gravity, slope)
        self.reset(np.zeros(3))

    def reset(self, pose: ArrayLike) -> None:
        """Reset the body to rest at `pose` (3,), at its settled height."""
        x, y, theta = checked_pose(pose)
        self._restart(self._model, self._data)
        # Position of the free joint, and its orientation as a unit quaternion.
        self._position[:7] = [x, y, self._resting_height, math.cos(theta / 2), 0.0, 0.0, math.sin(theta / 2)]
        self._position[7:] = 0.0
        if self._scene is not None:
            self._scene.restart()
        self._forward(self._model, self._data)
        self.c.yaw = theta

    def step(self, torques: FloatArray) -> None:
        """Apply wheel `torques` (4,) [N m] for one physics step.

        Raises
        ------
        sim.plants.plant.RobotLostError
            If the robot has tipped over, or a position or speed is not finite or exceeds the range of MuJoCo.
        """
        applied = np.array(torques, dtype=float)
        self.check(self._lib.twin_step_physics(self.c, address(applied)))

    def check(self, state: int) -> None:
        """Raise RobotLostError if `state`, the result of a step in C, indicates a lost robot."""
        if state == self._lib.TWIN_DIVERGED:
            raise RobotLostError(f"{self._now}: the simulation diverged; lower the forces of the scenario")
        if state == self._lib.TWIN_TIPPED:
            # The heading of a tipped robot is undefined, and only its wheels collide with the surface.
            remedy = "lower the force, height or payload of the scenario"
            raise RobotLostError(f"{self._now}: the robot has tipped over; {remedy}")

    def set_friction(self, friction: FloatArray) -> None:
        """Set the sliding friction coefficients (4,) along the rolling direction of the wheels, also after a reset."""
        # The first tangent of a contact is along the axle, the second along the rolling direction.
        self._model.pair_friction[:, 0] = self._sideways * friction * self._friction_scale
        self._model.pair_friction[:, 1] = friction * self._friction_scale

    def release(self) -> None:
        """End all pushes."""
        self._data.xfrc_applied[1] = 0.0

    def push(self, forward: float, left: float, yaw_torque: float, height: float) -> None:
        """Apply a push to the body until `release`: forces [N] in the body frame, and a torque [N m].

        The forces act at the horizontal position of the centre of mass, at `height` above the surface [m].
        """
        c, s = math.cos(self.c.yaw), math.sin(self.c.yaw)
        x, y = c * forward - s * left, s * forward + c * left
        # MuJoCo applies forces at the centre of mass, so a force at another height also causes a torque.
        lever = height - float(self._data.xipos[1, 2])
        self._data.xfrc_applied[1] += [x, y, 0.0, -lever * y, lever * x, yaw_torque]

    @property
    def pose(self) -> FloatArray:
        """(3,) x, y [m] of the point midway between the wheels, and theta [rad, unwrapped]."""
        return np.array([self._position[0], self._position[1], self.c.yaw])

    @property
    def twist(self) -> FloatArray:
        """(3,) forward and lateral speed [m/s] and yaw rate [rad/s] in the body frame."""
        vx, vy = float(self._velocity[0]), float(self._velocity[1])
        c, s = math.cos(self.c.yaw), math.sin(self.c.yaw)
        return np.array([c * vx + s * vy, c * vy - s * vx, self._velocity[5]])

    @property
    def yaw_rate(self) -> float:
        """Yaw rate [rad/s]."""
        return float(self._velocity[5])

    @property
    def _now(self) -> str:
        return f"t = {self._data.time:.2f} s"

    @property
    def wheel_speeds(self) -> FloatArray:
        """(4,) wheel speeds [rad/s]."""
        return np.array(self._velocity[6:10])

    @property
    def wheel_loads(self) -> FloatArray:
        """(4,) normal force of the surface on each wheel [N]."""
        import mujoco  # noqa: PLC0415 - an optional dependency

        loads, force = np.zeros(len(WHEELS)), np.zeros(6)
        for i in self._floor_contacts:
            mujoco.mj_contactForce(self._model, self._data, i, force)
            name = mujoco.mj_id2name(self._model, mujoco.mjtObj.mjOBJ_GEOM, self._data.contact[i].geom2)
            loads[WHEELS.index(name)] += force[0]
        return loads

    @property
    def _floor_contacts(self) -> list[int]:
        """Indices of the contacts with the surface, which is the first geom."""
        return [i for i in range(self._data.ncon) if self._data.contact[i].geom1 == 0]

    @property
    def energy(self) -> float:
        """Kinetic energy of body, wheels and rotors [J]."""
        import mujoco  # noqa: PLC0415 - an optional dependency

        momentum = np.zeros(self._model.nv)
        mujoco.mj_mulM(self._model, self._data, momentum, self._velocity)
        return float(0.5 * self._velocity @ momentum)


def _step_in_c(model: Any, data: Any, scene: Scene | None) -> Any:  # noqa: ANN401 - MuJoCo and cffi have no types
    """Return `mj_step` for C; return a Python callback if there is a scene, or if `mj_step` is not found."""
    import mujoco  # noqa: PLC0415 - an optional dependency

    ffi, _ = load_twin()
    kind, step = "void(*)(const void *, void *)", physics_step()
    if scene is not None:
        return ffi.callback(kind, lambda _model, _data: scene.step())
    if step is not None:
        return ffi.cast(kind, step)
    return ffi.callback(kind, lambda _model, _data: mujoco.mj_step(model, data))


def _tilted_gravity(gravity: FloatArray, slope: Slope) -> FloatArray:
    """Compute gravity (3,) [m/s^2] in the frame of a surface that is tilted by `slope`."""
    down, along = math.cos(slope.angle), math.sin(slope.angle)
    direction = np.array([along * math.cos(slope.downhill), along * math.sin(slope.downhill), -down])
    return np.asarray(np.linalg.norm(gravity) * direction)


def _split_tyre(tyre: Tyre) -> Tyre:
    """Compute the tyre parameters of two contact points whose total stiffness and damping are those of `tyre`.

    In MuJoCo, a contact with impedance d, time constant t and damping ratio z has the regularisation (1 - d) / d of its
    inverse mass, the damping 2 / (d t) and the stiffness 1 / (d t^2 z^2). Two contacts need twice the regularisation at
    equal damping and stiffness.
    """
    # Impedance d at which the regularisation (1 - d) / d is twice that of the tyre.
    impedance = 1.0 / (1.0 + 2.0 * (1.0 / tyre.impedance - 1.0))
    ratio = tyre.impedance / impedance
    return tyre.model_copy(
        update={
            "impedance": impedance,
            "contact_time": tyre.contact_time * ratio,
            "contact_damping": tyre.contact_damping / ratio**0.5,
            "creep_time": tyre.creep_time * ratio,
        }
    )


def _mjcf(
    robot: Robot, twin: TwinParameters, step: float, payload: Payload | None, aligned: bool, scene: Scene | None
) -> str:
    """Format the model as MJCF; if `aligned`, the first tangent of wheel contacts is along the axle."""
    chassis, tyre, radius = twin.chassis, twin.tyre, robot.wheel_radius
    front, half_track = 0.0 if chassis.castors else chassis.wheel_base / 2, robot.track / 2
    rear = front - chassis.wheel_base
    rolling_radii = [ratio * radius for ratio in chassis.rolling_radii] * 2
    shapes = [f'type="sphere" size="{wheel_radius}"' for wheel_radius in rolling_radii]
    if aligned:
        shapes = [f'type="capsule" size="{wheel_radius} {_CAPSULE}" euler="90 0 0"' for wheel_radius in rolling_radii]
        tyre = _split_tyre(tyre)
    wheel_positions = [(front, half_track), (front, -half_track), (rear, half_track), (rear, -half_track)]
    # A friction loss of zero is omitted, so that the joints have no constraint.
    drag = f' frictionloss="{chassis.wheel_drag}"' if chassis.wheel_drag else ""
    wheels = "".join(
        f'<body pos="{x} {y} 0"><joint type="hinge" axis="0 1 0" armature="{twin.motor.rotor_inertia}"{drag}/>'
        f'<geom name="{name}" {shape} mass="{chassis.wheel_mass}"/></body>'
        for name, shape, (x, y) in zip(WHEELS, shapes, wheel_positions, strict=True)
    )
    # Friction has a separate time constant; with the time constant of the normal direction, fast skidding would lift
    # the wheels.
    contacts = "".join(
        f'<pair geom1="floor" geom2="{name}" condim="3" friction="1 1 0 0 0"'
        f' solref="{tyre.contact_time} {tyre.contact_damping}" solreffriction="{tyre.creep_time} 1"'
        f' solimp="{tyre.impedance} {tyre.impedance} 0.001"/>'
        for name in WHEELS
    )
    length, width, height = (size / 2 for size in chassis.body_size)
    body_mass = robot.mass - 4 * chassis.wheel_mass
    # The wheels are symmetric, so the offset of the body alone determines the specified centre of mass of the robot.
    ahead, left = (robot.mass / body_mass * offset for offset in chassis.centre_of_mass)
    load = ""
    if payload is not None:
        load = (
            f'<geom type="sphere" size="{payload.radius}" pos="{payload.x} {payload.y} {payload.z}"'
            f' mass="{payload.mass}"/>'
        )
    # `autoreset` would hide divergence, and `island` has no benefit for a single robot.
    assets, obstacles, hull = (scene.assets, scene.obstacles, scene.hull(max(rolling_radii))) if scene else ("", "", "")
    return (
        f'<mujoco><option timestep="{step!r}" cone="elliptic" impratio="{tyre.creep_stiffness}"'
        ' integrator="implicitfast"><flag autoreset="disable" island="disable"/></option>'
        f'<default><geom contype="0" conaffinity="0"/></default>{assets}'
        '<worldbody><geom name="floor" type="plane" size="0 0 1"/>'
        f'<body pos="0 0 {max(rolling_radii)}"><freejoint/><geom type="box" size="{length} {width} {height}"'
        f' pos="{ahead} {left} {chassis.body_height}" mass="{body_mass}"/>{load}{hull}{wheels}</body>'
        f"{obstacles}</worldbody>"
        f"<contact>{contacts}</contact></mujoco>"
    )
