"""Control loop without ROS: read the sensors, compute and send the command 50 times per second."""

import math
import time

from diffdrive_mpc import Controller, Measurement, Stamped, integrate_pose, load_config, load_trajectory

PERIOD = 0.02  # [s]
WHEEL_RADIUS, TRACK = 0.0775, 0.44  # [m]


class SerialLine:
    """Placeholder for a motor driver, whose wheels follow the command immediately within its limits."""

    left = right = 0.0  # wheel speeds [rad/s]

    def send(self, v, omega):
        """Send a command; return the command that the firmware applies, which may be clipped or rounded."""
        v, omega = max(-0.8, min(0.8, v)), max(-1.5, min(1.5, omega))
        self.left, self.right = (v - 0.5 * TRACK * omega) / WHEEL_RADIUS, (v + 0.5 * TRACK * omega) / WHEEL_RADIUS
        return v, omega

    def read(self):
        """Read wheel speeds, left and right [rad/s], and the gyro's yaw rate [rad/s]."""
        return self.left, self.right, WHEEL_RADIUS * (self.right - self.left) / TRACK


line = SerialLine()
controller = Controller(load_config("ssm", {"sample_time": PERIOD, "horizon": 25}))
pose, sent, before = (0.0, 0.0, 0.0), None, 0.0
controller.start(load_trajectory("cane"), 0.0)
start = due = time.monotonic()
print("driving")
try:
    while True:
        now = time.monotonic() - start
        left, right, yaw_rate = line.read()
        v, omega = 0.5 * WHEEL_RADIUS * (left + right), WHEEL_RADIUS * (right - left) / TRACK
        # The pose is integrated from wheels and gyro, so it drifts; pass a pose from SLAM or a camera if available.
        pose, before = integrate_pose(pose, v, yaw_rate, now - before), now
        measurement = Measurement(
            pose=Stamped(pose, now), wheel_twist=Stamped((v, omega), now), yaw_rate=Stamped(yaw_rate, now), sent=sent
        )
        # `step` does not raise errors for data: invalid readings are rejected, and without poses the robot brakes.
        step = controller.step(now, measurement)
        sent = line.send(*step.command)
        if step.message:
            print(f"{now:5.2f} s {step.mode}: {step.message}")
        if step.mode == "FINISHED" and math.hypot(v, omega) < 0.01:
            break
        # Sleep until the next multiple of the period, so that errors do not accumulate.
        due += PERIOD
        time.sleep(max(0.0, due - time.monotonic()))
except KeyboardInterrupt:
    print("interrupted")
finally:
    sent = line.send(0.0, 0.0)  # the last command is always zero
    print(f"last command {sent}, at x = {pose[0]:.2f} m, y = {pose[1]:.2f} m")
