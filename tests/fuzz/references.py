"""Fuzzer of references from segments, waypoints and timed poses with unusual geometry and valid syntax."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from random import Random

from diffdrive_mpc import load_trajectory
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from fuzz.case import Case
from fuzz.controller import checked_reference, draw_speed
from fuzz.promises import refused_or


class ReferenceFuzzer:
    """Fuzzer of reference files; accepted references must be finite, continuous and within the limits."""

    name, time_limit, count = "references", 20.0, 300

    def draw(self, random: Random) -> Case:
        """Draw the content of a file."""
        kind = random.choice(("segments", "waypoints", "poses"))
        if kind == "segments":
            rows = [
                {
                    "v": draw_speed(random, 0.5),
                    "omega": draw_speed(random, 0.8),
                    "duration": abs(draw_speed(random, 2.0)),
                }
                for _ in range(random.choice((0, 1, 1, 2, 3, 8, 40)))
            ]
            timing = random.choice(("stop", "commanded", "smooth"))
            start = [draw_speed(random, 1.0) for _ in range(3)]
            return {"kind": kind, "rows": rows, "more": {"timing": timing, "start": start} | _smoothing(random)}
        if kind == "waypoints":
            rows = [
                [draw_speed(random, 2.0), draw_speed(random, 2.0)] for _ in range(random.choice((1, 2, 2, 3, 4, 8, 40)))
            ]
            if random.random() < 0.3:
                scale = 10.0 ** random.uniform(-8, 5)
                rows = [[scale * x, scale * y] for x, y in rows]
            options = {"timing": random.choice(("stop", "commanded", "smooth"))}
            return {
                "kind": kind,
                "rows": rows,
                "more": options | ({"speed": abs(draw_speed(random, 0.4))} if random.random() < 0.5 else {}),
            }
        t, x, y, theta, rows = 0.0, 0.0, 0.0, 0.0, []
        for _ in range(random.choice((1, 2, 3, 10, 100))):
            rows.append([t, x, y, theta])
            t += random.choice((0.02, 0.1, 0.1, 0.5, 0.0, -0.1, draw_speed(random, 1.0)))
            x += random.choice((0.0, 0.01, 0.03, draw_speed(random, 0.02)))
            y += random.choice((0.0, 0.0, draw_speed(random, 0.01)))
            theta += random.choice((0.0, 0.0, draw_speed(random, 0.05), 6.283185307179586))
        return {"kind": kind, "rows": rows, "more": {}}

    def check(self, case: Case) -> None:
        """Load the reference from a file."""
        with tempfile.TemporaryDirectory() as folder:
            if case["kind"] == "poses":
                path = Path(folder, "reference.csv")
                lines = ["t,x,y,theta", *(",".join(map(repr, row)) for row in case["rows"])]
                path.write_text("\n".join(lines) + "\n")
            else:
                # YAML has other names for NaN and infinity than JSON.
                path = Path(folder, "reference.yaml")
                text = json.dumps({case["kind"]: case["rows"], **case["more"]})
                path.write_text(text.replace("-Infinity", "-.inf").replace("Infinity", ".inf").replace("NaN", ".nan"))
            reference = refused_or(lambda: load_trajectory(path))
            if reference is not None:
                checked_reference(reference, TrajectoryLimits.of_robot())


def _smoothing(random: Random) -> dict[str, float]:
    return {"smoothing": abs(draw_speed(random, 0.05))} if random.random() < 0.3 else {}
