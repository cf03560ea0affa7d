"""Logs with causes that were told by nothing: turned frames, rounding, ramps, drifts, echoes; and sound ones beside."""

import numpy as np
from degraded_bases import HEAVY, SMALL, low_passed, robot
from degraded_changes import SIGN, UNIT, Case, from_the_middle, one_wheel, scaled, simulated

RPM = 60 / (2 * np.pi)


def turned(degrees):
    """Headings of a frame that is turned against the robot."""

    def change(columns, base):
        heading = columns[base.heading] + np.radians(degrees)
        return columns | {base.heading: (heading + np.pi) % (2 * np.pi) - np.pi}

    return change


def whole(quantum):
    """Commands rounded in the log; the robot got them as they were."""
    return lambda columns, base: columns | {name: np.round(columns[name] / quantum) * quantum for name in base.commands}


def clipped_side(level):
    """The left encoder reads no more than a share of its largest speed."""

    def change(columns, base):
        left = columns[base.wheels[0]]
        most = level * np.nanmax(np.abs(left))
        return columns | {base.wheels[0]: np.clip(left, -most, most)}

    return change


def both_swapped(columns, base):
    """Sides of encoders and commands exchanged."""
    left, right = base.wheels
    result = columns | {left: columns[right], right: columns[left]}
    one, two = base.commands
    if one == "v_ref":
        return result | {two: -columns[two]}
    return result | {one: columns[two], two: columns[one]}


def later(columns):
    return np.arange(len(columns["x"])) >= len(columns["x"]) // 2


def order_changes(columns, base):
    """Left and right of the encoders are exchanged from the middle on."""
    left, right = (columns[name] for name in base.wheels)
    names = dict(
        zip(base.wheels, (np.where(later(columns), *pair) for pair in ((right, left), (left, right))), strict=True)
    )
    return columns | names


def rectified(stream):
    return lambda columns, base: columns | {name: np.abs(columns[name]) for name in base.stream(stream)}


def filtered(stream, lag):
    return lambda columns, base: (
        columns | {name: low_passed(columns[name], lag, base.dt) for name in base.stream(stream)}
    )


def echoed(rows, radius=None, track=None):
    """What the encoders read, some rows later, stands where the command should."""

    def change(columns, base):
        left, right = (columns[name] for name in base.wheels)
        if radius is not None:
            left, right = 0.5 * radius * (left + right), radius * (right - left) / track
        late = np.clip(np.arange(len(left)) - rows, 0, None)
        return columns | {base.commands[0]: left[late], base.commands[1]: right[late]}

    return change


def latched(seconds, phase=0.5):
    """The logger takes the command over only now and then."""

    def change(columns, base):
        step = round(seconds / base.dt)
        first = round(phase * step)
        taken = np.clip((np.arange(len(columns["x"])) - first) // step * step + first, 0, None)
        return columns | {name: columns[name][taken] for name in base.commands}

    return change


def constant(*names, value=0.3):
    return lambda columns, base: columns | {name: np.full(len(columns[name]), value) for name in names}


def straight(columns, base):
    """Straight ahead alone; omega is commanded a residue of rounding."""
    columns = robot(drive=(1, 0), seed=41)
    return columns | {"omega_ref": columns["omega_ref"] + 2.6e-17 * np.random.default_rng(42).normal(size=6000)}


def of_a_controller(columns, base):
    """Sound: commands of a controller, new at each tick, and smooth."""
    return columns | {name: low_passed(columns[name], 0.02, base.dt) for name in base.commands}


CAUSES = (
    *(
        Case(base, f"pose turned by {angle}", turned(angle), ("turned pose",), ("pose", "heading_offset"))
        for base, angle in (("simulated", 40), ("husky", 25), ("heavy", -70), ("small", 40))
    ),
    Case("simulated", "commands in whole numbers", whole(1.0), ("rounded command",), ("command",), None),
    Case("heavy", "commands in halves", whole(0.5), ("rounded command",), ("command",), None),
    Case("small", "wheels ramped", simulated(**SMALL, ramp=0.6), ("ramped wheels",), ("wheel",)),
    Case("heavy", "wheels ramped", simulated(**HEAVY, ramp=0.5), ("ramped wheels",), ("wheel",)),
    Case("simulated", "left encoder clipped", clipped_side(0.4), ("clipped sensor",), ("left",), None),
    Case("husky", "left encoder clipped", clipped_side(0.5), ("clipped sensor",), ("left",), None),
    Case("asphalt", "commands in rpm", scaled(command=RPM), UNIT, ("command", "unit: rpm"), True),
    Case("gravel", "commands in rpm", scaled(command=RPM), UNIT, ("command", "unit: rpm"), True),
    Case("small", "omega commanded in rpm", scaled(omega_ref=RPM), UNIT, ("command", "unit: rpm"), True),
    *(
        Case(base, "encoders in rev/s", scaled(encoders=0.5 / np.pi), UNIT, ("encoders", "unit: rev/s"), True)
        for base in ("small", "husky", "asphalt")
    ),
    Case("heavy", "gyro in rev/s", scaled(gyro=0.5 / np.pi), UNIT, ("gyro", "unit: rev/s"), True),
    Case("husky", "all sides swapped", both_swapped, ("swapped sides",), ("encoders", "command"), True),
    Case("small", "all sides swapped", both_swapped, ("swapped sides", *SIGN), ("encoders", "command"), True),
    Case("simulated", "battery sags", simulated(sag=0.25, seed=43), ("gain drift",), ("command",), None),
    Case("heavy", "battery sags", simulated(**HEAVY, sag=0.25), ("gain drift",), ("command",), None),
    Case(
        "simulated",
        "command unit changes",
        lambda columns, base: columns | {"v_ref": columns["v_ref"] * np.where(later(columns), 100.0, 1.0)},
        ("scale change",),
        ("command",),
        True,
    ),
    Case("husky", "command unit changes", from_the_middle("command", RPM), ("scale change",), ("command",), True),
    Case("simulated", "joint order changes", order_changes, ("order change",), ("encoders",), True),
    Case("husky", "joint order changes", order_changes, ("order change",), ("encoders",), True),
    Case("simulated", "gyro rectified", rectified("gyro"), ("rectified sensor",), ("gyro",), True),
    Case("asphalt", "gyro rectified", rectified("gyro"), ("rectified sensor",), ("gyro",), True),
    Case("small", "encoders rectified", rectified("encoders"), ("rectified sensor",), ("encoders",), True),
    Case("simulated", "encoders filtered", filtered("encoders", 0.4), ("filtered sensor",), ("encoders",), None),
    Case("husky", "encoders filtered", filtered("encoders", 0.6), ("filtered sensor",), ("encoders",), None),
    Case("small", "odometry as command", echoed(1, 0.05, 0.3), ("echoed command",), ("command",), True),
    Case("heavy", "odometry as late command", echoed(15, 0.25, 0.8), ("echoed command",), ("command",), True),
    Case("husky", "odometry as command", echoed(0), ("echoed command",), ("command",), True),
    Case("simulated", "command latched", latched(2.0), ("latched command",), ("command",), True),
    Case("husky", "command latched", latched(2.0), ("latched command",), ("command",), True),
    Case("heavy", "slow yaw", simulated(**HEAVY, yaw_lag=0.5), ("slow yaw",), ("yaw",)),
    Case("simulated", "slow yaw", simulated(yaw_lag=0.4, seed=44), ("slow yaw",), ("yaw",)),
    Case("simulated", "straight ahead", straight, ("constant input",), ("omega",), True),
    Case(
        "small",
        "encoders constant",
        constant("left", "right"),
        ("no response",),
        ("encoders",),
        True,
        also=("stuck sensor",),
    ),
    Case("heavy", "heading constant", constant("theta"), ("no response",), ("pose",), True),
    Case("small", "right encoder constant", one_wheel(1, 0.0), ("dead wheel",), ("right",), True),
    # Sound.
    Case("small", "as it is", lambda columns, base: columns),
    Case("heavy", "as it is", lambda columns, base: columns),
    Case("small", "commands designed in halves", simulated(**SMALL, quantum=0.5)),
    Case("heavy", "commands designed in halves", simulated(**HEAVY, quantum=0.5)),
    Case("heavy", "commands of a controller", of_a_controller),
)
