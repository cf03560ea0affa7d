"""`python -m fuzz`: run fuzzers, and leave with 1 if they find anything. See CONTRIBUTING.md."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path

from fuzz.case import FINDINGS, saved_findings
from fuzz.fuzzers import FUZZERS
from fuzz.runner import Order, Ran, inside, judged, run

_LONGEST = 4 * 3600.0
"""For a number of steps [s]."""
_LONG = 20
"""A long run has so many times the cases of a short one ..."""
_SECONDS = {"short": 20.0, "long": 150.0}
"""... and ends after so long, if it is not through [s], for each fuzzer."""


def main() -> None:
    """Read the words, and run."""
    words = _words()
    if words.inside:
        order, report, folder = words.inside
        made = Order(**json.loads(order))
        inside(FUZZERS[made.fuzzer], made, Path(report), Path(folder))
        return
    if words.replay:
        sys.exit(_replayed(*words.replay))
    if "live" in words.what:
        # It needs ROS, which the others do without.
        from fuzz.live.run import main as attack

        seconds = words.seconds or {"short": 60.0, "long": 600.0}["long" if "long" in words.what else "short"]
        sys.exit(1 if attack(seconds, words.seed, None if words.keep == FINDINGS else words.keep, words.only) else 0)
    unknown = set(words.what) - {"short", "long", *FUZZERS}
    if unknown:
        sys.exit(f"error: unknown fuzzer '{min(unknown)}': give short, long, or some of {', '.join(FUZZERS)}")
    pace = "long" if "long" in words.what else "short"
    names = [name for name in FUZZERS if name in words.what] or list(FUZZERS)
    findings = 0
    for name in names:
        findings += _fuzzed(name, pace, words)
    sys.exit(1 if findings else 0)


def _fuzzed(name: str, pace: str, words: argparse.Namespace) -> int:
    count = FUZZERS[name].count * (_LONG if pace == "long" else 1) if words.count is None else words.count
    first, seconds = 0, _SECONDS[pace] if words.seconds is None else words.seconds
    if words.steps is not None:
        count, seconds = 10**9, words.seconds or _LONGEST
    if words.only is not None:
        first, count = words.only, 1
    started = time.monotonic()

    def say(ran: Ran, end: str = " so far") -> None:
        took = time.monotonic() - started
        steps = (
            f", {ran.steps} steps of at most {ran.longest_step:.2f} sample times, {ran.late} late" if ran.steps else ""
        )
        print(
            f"{name:12s} seed {words.seed}: {ran.cases} cases in {took:.0f} s{steps}, {len(ran.lines)} findings{end}",
            flush=True,
        )

    ran = run(Order(name, words.seed, first, count, seconds, words.steps or math.inf), words.keep, say)
    say(ran, "")
    for line in ran.lines:
        print(f"  - {line}", flush=True)
    return len(ran.lines)


def _replayed(name: str, mark: str) -> int:
    findings = judged(FUZZERS[name], saved_findings()[name, mark])
    print(findings[0] if findings else "no fault")
    return 1 if findings else 0


def _words() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("what", nargs="*", help=f"short (default) or long, and some of {', '.join(FUZZERS)}")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="this case alone")
    parser.add_argument("--count", type=int, help="so many cases of each fuzzer")
    parser.add_argument("--steps", type=int, help="of a controller, however many cases that takes")
    parser.add_argument("--seconds", type=float, help="at most so long for each fuzzer")
    parser.add_argument("--keep", type=Path, default=FINDINGS, help="folder for findings")
    parser.add_argument("--replay", nargs=2, metavar=("FUZZER", "MARK"), help="a kept finding, once more")
    parser.add_argument("--inside", nargs=3, help=argparse.SUPPRESS)
    return parser.parse_args()


if __name__ == "__main__":
    main()
