"""Robots with physics independent of the shipped plants: relaxing tyres, belts with backlash, and swivelling castors.

Motors are torque-limited PI loops on wheel speeds. The integration is explicit with a step of one millisecond. The seed
of the robot draws its parameters.
"""

import math
from collections import deque
from itertools import product

import numpy as np

from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.plants.drivetrain import clip_command
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from diffdrive_mpc.sim.sensing.sensors import Sensors

GRAVITY = 9.81
_STEP = 1e-3
_SLIP_SCALE = 0.02
"""Slip speed at which the friction is close to its limit [m/s]."""

_SWIVEL_INERTIA = 1e-3
"""Moment of inertia of a castor about its swivel [kg m^2]."""


class ForeignRobot:
    """Rigid body on driven wheels, a `sim.plants.plant.Plant`; the pose is that of the centre of the driven wheels.

    Parameters
    ----------
    robot
        Seed of the robot.
    seed
        Seed of the noise of a drive.
    sample_time
        Sample time of the controller [s], by default that of the shipped robot.
    """

    com_offset = 0.0
    """Distance from the centre of the driven wheels forward to the centre of mass [m]."""

    def __init__(self, robot, seed=0, sample_time=None):
        draw = np.random.default_rng([robot, 570]).uniform
        self._nominal = load_robot()
        self._kinematics = WheelKinematics(self._nominal.wheel_radius, self._nominal.track)
        self.sample_time = sample_time or self._nominal.sample_time
        self.radius, self.half_track = self._nominal.wheel_radius * draw(0.98, 1.02), 0.165 * draw(0.95, 1.05)
        self.mass, self.inertia, self.wheel_inertia = draw(6.0, 15.0), draw(0.15, 0.5), draw(0.004, 0.012)
        self.gains = draw(0.6, 1.5), draw(2.0, 8.0)
        self.torque, self.dead_time = draw(2.5, 5.0), int(draw(10, 60))
        self._draw_parameters(draw)
        self._sensors = Sensors(
            load_sensor_set("default"), self._kinematics, self.sample_time, seed=seed, noisy_encoders=True
        )
        self.reset(np.zeros(3))

    def _draw_parameters(self, draw):
        """Draw the parameters of this physics."""

    def reset(self, pose):
        self.tick, self._elapsed, self._last_command = 0, 0.0, None
        self.true_pose, self.true_twist = np.array(pose, dtype=float), np.zeros(3)
        self.wheel_speeds, self._integrals = [0.0, 0.0], [0.0, 0.0]
        self._commands = deque([(0.0, 0.0)] * self.dead_time)
        self._reset_states()
        self._sensors.reset(self.true_pose, np.zeros(4))

    def _reset_states(self):
        """Reset the states of this physics."""

    @property
    def time(self):
        return self.tick * self.sample_time

    def measure(self):
        return self._sensors.collect(self.time, self._last_command)

    def advance(self, command):
        v, omega = map(float, clip_command(command, self._nominal.limits))
        self._last_command = v, omega
        turn = omega * self._nominal.track / 2
        speeds = (v - turn) / self._nominal.wheel_radius, (v + turn) / self._nominal.wheel_radius
        self.tick += 1
        body = [*self.true_pose.tolist(), *self.true_twist.tolist()]
        while self._elapsed < self.time - _STEP / 2:
            self._commands.append(speeds)
            self._step(body, [self._servo(side, self._commands[0][side]) for side in (0, 1)])
            self._commands.popleft()
            self._elapsed += _STEP
        self.true_pose, self.true_twist = np.array(body[:3]), np.array(body[3:])
        for measurement_time in self._sensors.poses_due(self.time):
            self._sensors.add_pose(measurement_time, self.true_pose)
        self._sensors.add_motion(self.time, np.array(self.wheel_speeds * 2), body[5])

    def _servo(self, side, speed):
        """Return the motor torque of a side [N m]."""
        error = speed - self.wheel_speeds[side]
        torque = self.gains[0] * error + self.gains[1] * self._integrals[side]
        if abs(torque) < self.torque:
            self._integrals[side] += error * _STEP
        return max(-self.torque, min(self.torque, torque))

    def _step(self, body, torques):
        x, y, theta, v, lateral, omega = body
        forward, left, moment = self._forces(v, lateral, omega, torques)
        angular_acceleration = (moment - self.com_offset * left) / self.inertia
        body[3] += (forward / self.mass + omega * lateral + self.com_offset * omega**2) * _STEP
        body[4] += (left / self.mass - omega * v - self.com_offset * angular_acceleration) * _STEP
        body[5] += angular_acceleration * _STEP
        c, s = math.cos(theta), math.sin(theta)
        body[0], body[1] = x + (c * body[3] - s * body[4]) * _STEP, y + (s * body[3] + c * body[4]) * _STEP
        body[2] = theta + body[5] * _STEP

    def _forces(self, v, lateral, omega, torques):
        """Return forward and left force [N] and moment [N m] of the ground; advance wheels and inner states."""
        raise NotImplementedError


class RelaxingTyres(ForeignRobot):
    """Four driven wheels with tyres that deflect over a relaxation length, with Coulomb and viscous friction."""

    def _draw_parameters(self, draw):
        self.com_offset = draw(-0.02, 0.02)
        self.friction, self.viscous = draw(0.35, 0.9), draw(5.0, 20.0)
        self.relaxation, self.stiffness = draw(0.02, 0.08), draw(4.0, 10.0)
        self.half_base = draw(0.08, 0.13)

    def _reset_states(self):
        self._deflections = dict.fromkeys(product((1, -1), (0, 1)), (0.0, 0.0))

    def _forces(self, v, lateral, omega, torques):
        total, ground = [0.0, 0.0, 0.0], [0.0, 0.0]
        load = self.mass * GRAVITY / 4
        spring = load * self.stiffness / self.relaxation
        for (end, side), (along, across) in self._deflections.items():
            x, y = end * self.half_base, (1 - 2 * side) * self.half_track
            rolling = v - omega * y
            slip = self.radius * self.wheel_speeds[side] - rolling, -lateral - omega * x
            decay = abs(rolling) / self.relaxation
            elastic = along + (slip[0] - decay * along) * _STEP, across + (slip[1] - decay * across) * _STEP
            scale = min(1.0, self.friction * load / max(1e-9, spring * math.hypot(*elastic)))
            self._deflections[end, side] = scale * elastic[0], scale * elastic[1]
            forward, left = (spring * scale * d + self.viscous * s for d, s in zip(elastic, slip, strict=True))
            total[0] += forward
            total[1] += left
            total[2] += x * left - y * forward
            ground[side] += forward
        for side in (0, 1):
            resistance = 0.02 * 2 * load * self.radius * math.tanh(10 * self.wheel_speeds[side])
            torque = torques[side] - self.radius * ground[side] - resistance
            self.wheel_speeds[side] += torque / (2 * self.wheel_inertia) * _STEP
        return total


class BeltsWithBacklash(ForeignRobot):
    """Two wheels without slip, driven by belts with backlash; encoders are on the motors."""

    def _draw_parameters(self, draw):
        self.backlash, self.stiffness, self.damping = draw(0.005, 0.04), draw(20.0, 80.0), draw(0.1, 0.4)
        self.rolling = draw(0.01, 0.04)

    def _reset_states(self):
        self._belt_angles = [0.0, 0.0]

    def _forces(self, v, lateral, omega, torques):
        forces = []
        for side in (0, 1):
            rate = self.wheel_speeds[side] - (v + (2 * side - 1) * self.half_track * omega) / self.radius
            self._belt_angles[side] += rate * _STEP
            stretch = self._belt_angles[side] - max(-self.backlash, min(self.backlash, self._belt_angles[side]))
            belt = self.stiffness * stretch + (self.damping * rate if stretch else 0.0)
            self.wheel_speeds[side] += (
                (torques[side] - belt - 0.01 * self.wheel_speeds[side]) / self.wheel_inertia * _STEP
            )
            forces.append(belt / self.radius)
        left, right = forces
        resistance = self.rolling * self.mass * GRAVITY * math.tanh(v / _SLIP_SCALE)
        scrub = 0.02 * self.mass * GRAVITY * self.half_track * math.tanh(omega / 0.1)
        side_force = self.mass * omega * v - 200.0 * lateral  # prevents lateral sliding
        return left + right - resistance, side_force, (right - left) * self.half_track - scrub


class SwivellingCastors(ForeignRobot):
    """Two driven wheels and two front castors; side forces turn the castors and act on the body."""

    def _draw_parameters(self, draw):
        self.com_offset = draw(0.03, 0.10)
        self.pivot, self.spread, self.trail = draw(0.2, 0.3), draw(0.08, 0.14), draw(0.015, 0.04)
        self.friction, self.swivel, self.rolling = draw(0.4, 0.8), draw(0.01, 0.05), draw(0.01, 0.04)

    def _reset_states(self):
        self._swivels = [(0.0, 0.0), (0.0, 0.0)]

    def _forces(self, v, lateral, omega, torques):
        weight = self.mass * GRAVITY
        castor_load = weight * self.com_offset / self.pivot / 2
        load = weight / 2 - castor_load
        forward, moment = 0.0, 0.0
        across = -2 * self.friction * load * math.tanh(lateral / _SLIP_SCALE)
        for side in (0, 1):
            y = (1 - 2 * side) * self.half_track
            slip = self.radius * self.wheel_speeds[side] - (v - omega * y)
            force = self.friction * load * math.tanh(slip / _SLIP_SCALE)
            forward, moment = forward + force, moment - y * force
            self.wheel_speeds[side] += (torques[side] - self.radius * force) / self.wheel_inertia * _STEP
        for side, (angle, rate) in enumerate(self._swivels):
            y, c, s = (1 - 2 * side) * self.spread, math.cos(angle), math.sin(angle)
            ahead, left = v - omega * y, lateral + omega * self.pivot
            rolling, sliding = c * ahead + s * left, c * left - s * ahead - self.trail * (omega + rate)
            along = -self.rolling * castor_load * math.tanh(rolling / _SLIP_SCALE)
            side_force = -self.friction * castor_load * math.tanh(sliding / (2 * _SLIP_SCALE))
            bearing = -self.swivel * math.tanh(rate / 0.2)
            new_rate = rate + (bearing - self.trail * side_force) / _SWIVEL_INERTIA * _STEP
            self._swivels[side] = angle + new_rate * _STEP, new_rate
            x_force, y_force = c * along - s * side_force, s * along + c * side_force
            forward, across = forward + x_force, across + y_force
            moment += self.pivot * y_force - y * x_force - bearing
        return forward, across, moment


FOREIGN = {"tyres": RelaxingTyres, "belts": BeltsWithBacklash, "castors": SwivellingCastors}
