"""Robots on floors that are known in closed form, and Dubins' shortest ways."""

import itertools

import numpy as np

from diffdrive_mpc_extras.turn_costs import SlipCoefficients, TorqueTable, TurnCosts, load_drive_constants, load_vehicle

BOT, MOTORS = load_vehicle("fsu_bot"), load_drive_constants("fsu_bot")
SPEED = 0.4


def floor(name, radius, outer, inner, *, drive=MOTORS, slip=None):
    """A floor with the torques of both sides [N m] at each turning radius [m]."""
    curve = TorqueTable(
        radius=tuple(radius.tolist()),
        outer=tuple(outer.tolist()),
        inner=tuple(inner.tolist()),
        speed=SPEED,
        speed_exponent=0.0,
    )
    slip = slip or SlipCoefficients()
    return TurnCosts(name=name, vehicle=BOT, drive=drive, slip=slip, curve=curve, provenance="a test")


def stiff(least, slip=None):
    """A floor on which the outer side is at its limit below a radius, and asks less the wider the turn."""
    radius = np.geomspace(0.2, 500.0, 60)
    turn = np.minimum(4.6, 0.95 * 4.6 * (least / radius) ** 1.2)
    return floor(f"least radius {least:g} m", radius, (turn + 0.2).clip(max=4.6), 0.22 - turn, slip=slip)


def sliding(slip=None):
    """Dry friction: every turn asks the same torques, nothing is given back, and nothing is lost in windings."""
    radius = np.geomspace(0.02, 2000.0, 80)
    turn = np.where(radius < 100.0, 2.0, 2.0 * (100.0 / radius))
    inner = np.where(radius < 0.195, -0.21, 0.21) - turn
    drive = MOTORS.model_copy(update={"resistance": 0.0, "regeneration": False})
    return floor("dry friction", radius, 0.21 + turn, inner, drive=drive, slip=slip)


def dubins(start, goal, radius):
    """Length of the shortest way of bounded curvature: the six words in the closed form of Shkel and Lumelsky, 2001."""
    dx, dy = (np.asarray(goal) - start)[:2] / radius
    far, toward = np.hypot(dx, dy), np.arctan2(dy, dx)
    a, b = np.mod(start[2] - toward, 2 * np.pi), np.mod(goal[2] - toward, 2 * np.pi)
    sa, sb, ca, cb, cab = np.sin(a), np.sin(b), np.cos(a), np.cos(b), np.cos(a - b)
    whole = lambda angle: np.mod(angle, 2 * np.pi)  # noqa: E731
    found = []
    square = 2 + far**2 - 2 * cab + 2 * far * (sa - sb)
    if square >= 0:
        t = np.arctan2(cb - ca, far + sa - sb)
        found.append(whole(t - a) + np.sqrt(square) + whole(b - t))
    square = 2 + far**2 - 2 * cab + 2 * far * (sb - sa)
    if square >= 0:
        t = np.arctan2(ca - cb, far - sa + sb)
        found.append(whole(a - t) + np.sqrt(square) + whole(t - b))
    square = -2 + far**2 + 2 * cab + 2 * far * (sa + sb)
    if square >= 0:
        p = np.sqrt(square)
        t = np.arctan2(-ca - cb, far + sa + sb) - np.arctan2(-2.0, p)
        found.append(whole(t - a) + p + whole(t - b))
    square = -2 + far**2 + 2 * cab - 2 * far * (sa + sb)
    if square >= 0:
        p = np.sqrt(square)
        t = np.arctan2(ca + cb, far - sa - sb) - np.arctan2(2.0, p)
        found.append(whole(a - t) + p + whole(b - t))
    for side in (1, -1):
        bent = (6 - far**2 + 2 * cab + side * 2 * far * (sa - sb)) / 8
        if abs(bent) <= 1:
            p = whole(2 * np.pi - np.arccos(bent))
            if side == 1:
                t = whole(a - np.arctan2(ca - cb, far - sa + sb) + p / 2)
                found.append(t + p + whole(a - b - t + p))
            else:
                t = whole(-a + np.arctan2(-ca + cb, far + sa - sb) + p / 2)
                found.append(t + p + whole(b - a - t + p))
    return radius * min(found)


def dense_energy(costs, start, goal, radii):
    """Least energy of arc-straight-arc over pairs of radii, each by forward integration: slow and plain."""
    best, chosen = np.inf, None
    power = lambda v, w: float(costs.power([[v, w]])[0])  # noqa: E731
    straight = power(SPEED, 0.0) / SPEED
    for (r1, r2), s1, s2 in itertools.product(itertools.product(radii, radii), (1, -1), (1, -1)):
        # Without slip: centres to the left or right at the radius.
        c1 = start[:2] + s1 * r1 * np.array([-np.sin(start[2]), np.cos(start[2])])
        c2 = goal[:2] + s2 * r2 * np.array([-np.sin(goal[2]), np.cos(goal[2])])
        gap, offset = c2 - c1, s2 * r2 - s1 * r1
        far = np.hypot(*gap)
        if far < abs(offset):
            continue
        length = np.sqrt(far**2 - offset**2)
        heading = np.arctan2(gap[1], gap[0]) - np.arctan2(offset, length)
        t1, t2 = np.mod(s1 * (heading - start[2]), 2 * np.pi), np.mod(s2 * (goal[2] - heading), 2 * np.pi)
        energy = straight * length
        for r, turn in ((r1, t1), (r2, t2)):
            if 1e-9 < turn < 2 * np.pi - 1e-9:
                energy += power(SPEED, SPEED / r) * turn * r / SPEED
        if energy < best:
            best, chosen = energy, (r1, r2)
    return best, chosen
