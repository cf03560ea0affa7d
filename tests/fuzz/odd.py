"""Numbers and words that nobody expects."""

from __future__ import annotations

import math
import sys
from random import Random

NUMBERS = (
    math.nan,
    math.inf,
    -math.inf,
    sys.float_info.max,
    -sys.float_info.max,
    1e300,
    -1e300,
    1e154,
    -1e154,
    1e100,
    -1e30,
    1e30,
    1e19,
    2.0**63,
    -(2.0**63),
    1e15,
    -1e15,
    1e9,
    -1e9,
    1e6,
    -1e6,
    4e3,
    100.0,
    -50.0,
    10.0,
    -1.0,
    1.0,
    0.5,
    1e-3,
    1e-6,
    -1e-6,
    1e-12,
    1e-100,
    sys.float_info.min,
    5e-324,
    -5e-324,
    0.0,
    -0.0,
    math.pi,
    -math.pi,
)
"""Those that break arithmetic."""

INTEGERS = (
    0,
    1,
    -1,
    2,
    3,
    10,
    127,
    128,
    255,
    256,
    1000,
    65535,
    65536,
    2**31 - 1,
    2**31,
    -(2**31),
    2**53 + 1,
    2**63,
    10**30,
)
"""The same of integers."""

WORDS = (
    "",
    " ",
    "ssm",
    "sm",
    "nan",
    "inf",
    "-inf",
    "null",
    "~",
    "true",
    "no",
    "0",
    "-1",
    "1e999",
    "..",
    ".",
    "/",
    "/dev/null",
    "/etc/passwd",
    "a" * 5000,
    "\x1b[31mred\x1b[0m",
    "two\nlines",
    "tab\there",
    "\x00",
    "\u202eright to left",
    "\ud800".encode("utf-8", "surrogatepass").decode("latin-1"),
    "ä",
    "x */ int y; /*",
    "%s%n",
    "${HOME}",
    "$(id)",
    "`id`",
    "'",
    '"',
    "{}",
    "[]",
    "!!int x",
    "&a",
    "*a",
    "2020-13-40",
    "0x10",
    "1_000",
    ".5",
    "+",
    "-",
    "--help",
    "💥",
)
"""Words that end up where a name, a path or a number is looked for."""


def number(random: Random) -> float:
    """An odd number."""
    return random.choice(NUMBERS)


def near(value: float, random: Random) -> float:
    """A number that may stand where `value` stood: scaled, moved by a little, or odd."""
    way = random.randrange(6)
    if way == 0:
        return number(random)
    if way == 1:
        return -value
    if way == 2:
        return value * 10.0 ** random.uniform(-12, 12)
    if way == 3:
        return math.nextafter(value, math.inf * random.choice((-1, 1)))
    if way == 4:
        return 0.0
    return value * random.uniform(0.0, 3.0)
