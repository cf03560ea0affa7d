"""Link, firmware, motor drivers and motors, implemented independently with Python numbers."""

from __future__ import annotations

import math
from collections import deque

from diffdrive_mpc.models.robot import Robot
from diffdrive_mpc.sim.plants.twin_parameters import Firmware, TwinParameters


class Drivetrain:
    """Model from sent commands to wheel torques, with scalar operations on lists."""

    def __init__(self, firmware: Firmware, twin: TwinParameters, robot: Robot, step: float, phase: list[float]) -> None:
        self.twin, self.step, self.phase = twin, step, phase
        self.pulse = 2 * math.pi / robot.encoder_pulses
        self.decay = [math.exp(-step / lag) for lag in (firmware.lag_v, firmware.lag_omega)]
        self.by_v = firmware.gain_v / robot.wheel_radius / self.pulse
        self.by_omega = 0.5 * firmware.track / robot.wheel_radius / self.pulse
        pole = math.exp(-twin.driver.observer_bandwidth * step)
        self.angle_gain, self.speed_gain = 1 - pole**2, (1 - pole) ** 2 / step
        self.under_way: deque[tuple[float, list[float]]] = deque()
        self.acting, self.filtered = [0.0, 0.0], [0.0, 0.0]
        self.angle = [self.counted(i, 0.0) for i in range(4)]
        self.speed, self.integral, self.supply = [0.0] * 4, [0.0] * 4, 1.0

    def send(self, time: float, command: list[float]) -> None:
        self.under_way.append((time + self.twin.link.dead_time, command))

    def arrived(self, start: float, end: float) -> list[float]:
        total, since = [0.0, 0.0], start
        while self.under_way and self.under_way[0][0] < end:
            arrival, command = self.under_way.popleft()
            arrival = max(arrival, since)
            total = [sum_ + (arrival - since) * value for sum_, value in zip(total, self.acting, strict=True)]
            self.acting, since = command, arrival
        if since == start:
            return self.acting
        return [(sum_ + (end - since) * value) / (end - start) for sum_, value in zip(total, self.acting, strict=True)]

    def set_points(self, command: list[float]) -> list[float]:
        self.filtered = [
            now + decay * (before - now) for now, decay, before in zip(command, self.decay, self.filtered, strict=True)
        ]
        v, omega = self.filtered
        # Half a pulse is rounded to even, in Python as in C.
        return [round(self.by_v * v + side * self.by_omega * omega) * self.pulse for side in (-1, 1, -1, 1)]

    def counted(self, wheel: int, angle: float) -> float:
        return math.floor(angle / self.pulse + self.phase[wheel]) * self.pulse

    def observe(self, angles: list[float]) -> None:
        for i, angle in enumerate(angles):
            predicted = self.angle[i] + self.step * self.speed[i]
            error = self.counted(i, angle) - predicted
            self.angle[i] = predicted + self.angle_gain * error
            self.speed[i] = self.speed[i] + self.speed_gain * error

    def torques(self, start: float, end: float, speeds: list[float]) -> list[float]:
        driver, motor = self.twin.driver, self.twin.motor
        torques = []
        for i, set_point in enumerate(self.set_points(self.arrived(start, end))):
            error = set_point - self.speed[i]
            resting = set_point == 0.0 and abs(self.speed[i]) < self.pulse / self.step / 10
            if resting:
                self.integral[i] = 0.0
            wanted = set_point / motor.no_load_speed + driver.proportional_gain * error + self.integral[i]
            duty = 0.0 if resting else min(max(wanted, -1.0), 1.0)
            stall = motor.stall_torque * motor.spread[i]
            torque = stall * (self.supply * duty - speeds[i] / motor.no_load_speed)
            limit = math.inf if driver.torque_limit is None else driver.torque_limit
            limited = min(max(torque, -limit), limit)
            if duty == wanted and limited == torque:
                self.integral[i] += self.step * driver.integral_gain * error
            torques.append(limited)
        return torques
