"""Extreme numbers and unusual texts."""

from __future__ import annotations

import math
import sys
from random import Random

LARGE = (math.inf, sys.float_info.max, 1e300, 1e154, 1e30, 2.0**63, 1e15, 1e9, 1e6)
SMALL = (1.0, 1e-3, 1e-6, 1e-100, 5e-324, 0.0, math.pi)
NUMBERS = (math.nan, *LARGE, *(-value for value in LARGE), *SMALL, *(-value for value in SMALL), 4e3, 100.0, -50.0)
"""Numbers for which arithmetic may overflow, underflow or give NaN."""

INTEGERS = (0, 1, -1, 2, 10, 127, 256, 1000, 65536, 2**31 - 1, 2**31, -(2**31), 2**53 + 1, 2**63, 10**30)

WORDS = (
    *("", " ", "ssm", "nan", "-inf", "null", "true", "no", "-1", "1e999", "0x10", "1_000", "2020-13-40"),
    *("..", "/", "/dev/null", "/etc/passwd", "${HOME}", "$(id)", "%s%n", "--help", "x */ int y; /*"),
    *("\x1b[31mred\x1b[0m", "two\nlines", "tab\there", "\x00", "\u202eright to left", "ä", "💥", "a" * 5000),
    *("'", '"', "{}", "[]", "!!int x", "&a", "*a"),
    "\ud800".encode("utf-8", "surrogatepass").decode("latin-1"),
)
"""Unusual texts in place of a name, a path or a number."""


def number(random: Random) -> float:
    """Draw an extreme number."""
    return random.choice(NUMBERS)


def near(value: float, random: Random) -> float:
    """Return a number that may replace `value`: scaled, slightly changed, or extreme."""
    kind = random.randrange(6)
    if kind == 0:
        return number(random)
    if kind == 1:
        return -value
    if kind == 2:
        return value * 10.0 ** random.uniform(-12, 12)
    if kind == 3:
        return math.nextafter(value, math.inf * random.choice((-1, 1)))
    if kind == 4:
        return 0.0
    return value * random.uniform(0.0, 3.0)
