"""Robots of physics that no shipped plant contains: tyres that relax, belts with backlash, and swivelling castors.

Motors are torque-limited PI loops on wheel speeds; forces are integrated in explicit steps of a millisecond. Numbers
are drawn by the seed of the robot.
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
_SOFT = 0.02
"""Slip speed at which friction is nearly full [m/s]."""

_SWIVEL_INERTIA = 1e-3
"""Moment of inertia of a castor about its swivel [kg m^2]."""


class ForeignRobot:
    """Rigid body on driven wheels; see `sim.plants.plant.Plant`. Poses are midway between the driven wheels.

    Parameters
    ----------
    robot
        Seed of the robot.
    seed
        Seed of the noise of a drive.
    """

    ahead = 0.0
    """Distance of the centre of mass ahead of the poses [m]."""

    def __init__(self, robot, seed=0):
        draw = np.random.default_rng([robot, 570]).uniform
        self._nominal = load_robot()
        self._kinematics = WheelKinematics(self._nominal.wheel_radius, self._nominal.track)
        self.sample_time = self._nominal.sample_time
        self.radius, self.half_track = self._nominal.wheel_radius * draw(0.98, 1.02), 0.165 * draw(0.95, 1.05)
        self.mass, self.inertia, self.wheel_inertia = draw(6.0, 15.0), draw(0.15, 0.5), draw(0.004, 0.012)
        self.gains = draw(0.6, 1.5), draw(2.0, 8.0)
        self.torque, self.dead_time = draw(2.5, 5.0), int(draw(10, 60))
        self._draw(draw)
        self._sensors = Sensors(
            load_sensor_set("default"), self._kinematics, self.sample_time, seed=seed, noisy_encoders=True
        )
        self.reset(np.zeros(3))

    def _draw(self, draw):
        """Draw the numbers of this physics."""

    def reset(self, pose):
        self.tick, self._elapsed, self._sent = 0, 0.0, None
        self.true_pose, self.true_twist = np.array(pose, dtype=float), np.zeros(3)
        self.spin, self._sums = [0.0, 0.0], [0.0, 0.0]
        self._commands = deque([(0.0, 0.0)] * self.dead_time)
        self._rest()
        self._sensors.reset(self.true_pose, np.zeros(4))

    def _rest(self):
        """Reset the states of this physics."""

    @property
    def time(self):
        return self.tick * self.sample_time

    def measure(self):
        return self._sensors.collect(self.time, self._sent)

    def advance(self, command):
        sent = clip_command(command, self._nominal.limits)
        self._sent = float(sent[0]), float(sent[1])
        turn = sent[1] * self._nominal.track / 2
        speeds = (sent[0] - turn) / self._nominal.wheel_radius, (sent[0] + turn) / self._nominal.wheel_radius
        self.tick += 1
        body = [*self.true_pose.tolist(), *self.true_twist.tolist()]
        while self._elapsed < self.time - _STEP / 2:
            self._commands.append(speeds)
            self._step(body, [self._servo(side, self._commands[0][side]) for side in (0, 1)])
            self._commands.popleft()
            self._elapsed += _STEP
        self.true_pose, self.true_twist = np.array(body[:3]), np.array(body[3:])
        for look in self._sensors.poses_due(self.time):
            self._sensors.add_pose(look, self.true_pose)
        self._sensors.add_motion(self.time, np.array(self.spin * 2), body[5])

    def _servo(self, side, speed):
        """Return the motor torque of a side [N m]."""
        error = speed - self.spin[side]
        wanted = self.gains[0] * error + self.gains[1] * self._sums[side]
        if abs(wanted) < self.torque:
            self._sums[side] += error * _STEP
        return max(-self.torque, min(self.torque, wanted))

    def _step(self, body, torques):
        x, y, theta, v, lateral, omega = body
        forward, across, moment = self._forces(v, lateral, omega, torques)
        turn = (moment - self.ahead * across) / self.inertia
        body[3] += (forward / self.mass + omega * lateral + self.ahead * omega**2) * _STEP
        body[4] += (across / self.mass - omega * v - self.ahead * turn) * _STEP
        body[5] += turn * _STEP
        c, s = math.cos(theta), math.sin(theta)
        body[0], body[1] = x + (c * body[3] - s * body[4]) * _STEP, y + (s * body[3] + c * body[4]) * _STEP
        body[2] = theta + body[5] * _STEP

    def _forces(self, v, lateral, omega, torques):
        """Return forces [N] and moment about the pose [N m] of the ground, and advance wheels and inner states."""
        raise NotImplementedError


class RelaxingTyres(ForeignRobot):
    """Four driven wheels whose tyres deflect over a relaxation length before they slide (Coulomb and viscous)."""

    def _draw(self, draw):
        self.ahead = draw(-0.02, 0.02)
        self.friction, self.viscous = draw(0.35, 0.9), draw(5.0, 20.0)
        self.relaxation, self.stiffness = draw(0.02, 0.08), draw(4.0, 10.0)
        self.half_base = draw(0.08, 0.13)

    def _rest(self):
        self._bent = dict.fromkeys(product((1, -1), (0, 1)), (0.0, 0.0))

    def _forces(self, v, lateral, omega, torques):
        total, ground = [0.0, 0.0, 0.0], [0.0, 0.0]
        load = self.mass * GRAVITY / 4
        spring = load * self.stiffness / self.relaxation
        for (end, side), (along, across) in self._bent.items():
            x, y = end * self.half_base, (1 - 2 * side) * self.half_track
            rolling = v - omega * y
            slip = self.radius * self.spin[side] - rolling, -lateral - omega * x
            decay = abs(rolling) / self.relaxation
            bent = along + (slip[0] - decay * along) * _STEP, across + (slip[1] - decay * across) * _STEP
            share = min(1.0, self.friction * load / max(1e-9, spring * math.hypot(*bent)))
            self._bent[end, side] = share * bent[0], share * bent[1]
            forward, left = (spring * share * b + self.viscous * s for b, s in zip(bent, slip, strict=True))
            total[0] += forward
            total[1] += left
            total[2] += x * left - y * forward
            ground[side] += forward
        for side in (0, 1):
            resistance = 0.02 * 2 * load * self.radius * math.tanh(10 * self.spin[side])
            torque = torques[side] - self.radius * ground[side] - resistance
            self.spin[side] += torque / (2 * self.wheel_inertia) * _STEP
        return total


class SlackBelts(ForeignRobot):
    """Two wheels that roll without slip, driven by belts with backlash; encoders are on the motors."""

    def _draw(self, draw):
        self.slack, self.stiffness, self.damping = draw(0.005, 0.04), draw(20.0, 80.0), draw(0.1, 0.4)
        self.rolling = draw(0.01, 0.04)

    def _rest(self):
        self._wound = [0.0, 0.0]

    def _forces(self, v, lateral, omega, torques):
        forces = []
        for side in (0, 1):
            rate = self.spin[side] - (v + (2 * side - 1) * self.half_track * omega) / self.radius
            self._wound[side] += rate * _STEP
            beyond = self._wound[side] - max(-self.slack, min(self.slack, self._wound[side]))
            belt = self.stiffness * beyond + (self.damping * rate if beyond else 0.0)
            self.spin[side] += (torques[side] - belt - 0.01 * self.spin[side]) / self.wheel_inertia * _STEP
            forces.append(belt / self.radius)
        left, right = forces
        resistance = self.rolling * self.mass * GRAVITY * math.tanh(v / _SOFT)
        scrub = 0.02 * self.mass * GRAVITY * self.half_track * math.tanh(omega / 0.1)
        across = self.mass * omega * v - 200.0 * lateral  # wheels that do not slide sideways
        return left + right - resistance, across, (right - left) * self.half_track - scrub


class SwivellingCastors(ForeignRobot):
    """Two driven wheels and two castors in front, whose side forces turn them about their swivels and push the body."""

    def _draw(self, draw):
        self.ahead = draw(0.03, 0.10)
        self.pivot, self.spread, self.trail = draw(0.2, 0.3), draw(0.08, 0.14), draw(0.015, 0.04)
        self.friction, self.swivel, self.rolling = draw(0.4, 0.8), draw(0.01, 0.05), draw(0.01, 0.04)

    def _rest(self):
        self._swivels = [(0.0, 0.0), (0.0, 0.0)]

    def _forces(self, v, lateral, omega, torques):
        weight = self.mass * GRAVITY
        carried = weight * self.ahead / self.pivot / 2  # of each castor
        load = weight / 2 - carried
        forward, moment = 0.0, 0.0
        across = -2 * self.friction * load * math.tanh(lateral / _SOFT)
        for side in (0, 1):
            y = (1 - 2 * side) * self.half_track
            slip = self.radius * self.spin[side] - (v - omega * y)
            force = self.friction * load * math.tanh(slip / _SOFT)
            forward, moment = forward + force, moment - y * force
            self.spin[side] += (torques[side] - self.radius * force) / self.wheel_inertia * _STEP
        for side, (angle, rate) in enumerate(self._swivels):
            y, c, s = (1 - 2 * side) * self.spread, math.cos(angle), math.sin(angle)
            ahead, left = v - omega * y, lateral + omega * self.pivot
            rolling, sliding = c * ahead + s * left, c * left - s * ahead - self.trail * (omega + rate)
            along = -self.rolling * carried * math.tanh(rolling / _SOFT)
            push = -self.friction * carried * math.tanh(sliding / (2 * _SOFT))
            bearing = -self.swivel * math.tanh(rate / 0.2)
            faster = rate + (bearing - self.trail * push) / _SWIVEL_INERTIA * _STEP
            self._swivels[side] = angle + faster * _STEP, faster
            x_force, y_force = c * along - s * push, s * along + c * push
            forward, across = forward + x_force, across + y_force
            moment += self.pivot * y_force - y * x_force - bearing
        return forward, across, moment


FOREIGN = {"tyres": RelaxingTyres, "belts": SlackBelts, "castors": SwivellingCastors}
