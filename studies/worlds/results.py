"""What the study keeps of a run, and the tables of it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import run_case
from diffdrive_mpc.bench.outcomes import group, plain
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.statistics import Estimate, Rate, mean, median
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.worlds.passage import Passage
from studies.worlds.stop_oracle import stop_was_possible

_KEPT = 10
"""Every so many ticks the place is kept, for pictures."""


@dataclass(frozen=True)
class WorldOutcome:
    """One run of the study.

    Attributes
    ----------
    part
        Of the study.
    case
        What was run.
    passage
        What came of it.
    ended, message
        Why it ended early, and what its controller said last; empty for nothing.
    stop_possible
        Where persons walk: whether a stop in time was physically possible; None for nobody to stop for.
    path
        (m, 2) places of the robot [m], for pictures.
    duration
        Of the way as it was planned [s].
    step_p99, step_max
        Of the controller's step [s].
    processor_s
        Of the run [s].
    """

    part: str
    case: Case
    passage: Passage
    ended: str
    message: str
    stop_possible: bool | None
    path: FloatArray
    duration: float
    step_p99: float
    step_max: float
    processor_s: float

    @property
    def driver(self) -> str:
        """Who drove, as tables call it."""
        return self.case.controller if self.case.controller in PEERS else f"mpc, {self.case.model}"

    @property
    def through(self) -> bool:
        """Whether posts stood on the planned way."""
        return self.case.world.endswith(":through")

    def as_json(self) -> dict[str, object]:
        """Labels and numbers as plain values."""
        own = ("part", "ended", "message", "stop_possible", "duration", "processor_s")
        values = {name: getattr(self, name) for name in own} | self.case.as_row() | asdict(self.passage)
        row: dict[str, object] = plain(values, 6)
        return row


def run_world(part: str, case: Case) -> WorldOutcome:
    """Drive one case and keep what the study shows."""
    began = time.process_time()
    run = run_case(case)
    took = time.process_time() - began
    assert run.passage is not None and run.world is not None
    said = [message for message in run.messages if message]
    steps = run.step_time[np.isfinite(run.step_time)]
    return WorldOutcome(
        part,
        case,
        run.passage,
        run.ended,
        said[-1] if said else "",
        stop_was_possible(case, run) if run.world.movers else None,
        run.true_pose[::_KEPT, :2].copy(),
        run.reference.duration,
        float(np.percentile(steps, 99)) if steps.size else float("nan"),
        float(steps.max(initial=0.0)),
        took,
    )


Rows = Sequence[WorldOutcome]


def rate(rows: Rows, counted: Callable[[WorldOutcome], bool]) -> Rate:
    """The share of runs for which something holds, with its interval."""
    return Rate.of_runs(sum(map(counted, rows)), len(rows))


def collided(one: WorldOutcome) -> bool:
    """Whether the robot touched something while it moved."""
    return one.passage.contacts > 0


def arrived(one: WorldOutcome) -> bool:
    """Whether it came to its goal in time, without a contact."""
    return one.passage.arrived


def lateness(rows: Rows) -> Estimate:
    """Mean of the time to the goal over that of the planned way, of runs that arrived."""
    return Estimate.of_runs([one.passage.time_s / one.duration for one in rows if arrived(one)], mean)


def study_tables(rows: Rows) -> list[Table]:
    """A table for each part that was run."""
    parts = group(rows, lambda one: one.part)
    made = []
    if "drawn" in parts:
        made += [_drawn(parts["drawn"]), _conditions(parts["drawn"])]
    if "crossing" in parts:
        made.append(_crossings(parts["crossing"]))
    named = [*parts.get("doorway", []), *parts.get("named", [])]
    if named:
        made.append(_named(named))
    return [*made, _contacts(rows), _cost(rows)]


def _drawn(rows: Rows) -> Table:
    kinds = {False: "free", True: "posts on it"}
    entries = [
        ((kinds[through], driver), runs)
        for through, part in sorted(group(rows, lambda one: one.through).items())
        for driver, runs in group(part, lambda one: one.driver).items()
    ]
    columns: dict[str, Callable[[Rows], str]] = {
        "runs": lambda runs: str(len(runs)),
        "arrived [%]": lambda runs: interval(rate(runs, arrived)),
        "collided [%]": lambda runs: interval(rate(runs, collided)),
        "stood still [%]": lambda runs: interval(rate(runs, lambda one: not arrived(one) and not collided(one))),
        "time over planned": lambda runs: estimate(lateness(runs), 2),
        "least clearance, median [m]": lambda runs: number(_clearance(runs).value, 3),
    }
    note = (
        "The planned way is free, or posts were put onto it; a robot that arrives has touched nothing. Brackets: 95 % "
        "intervals, exact of rates, bootstrap of the mean time. Clearance: of runs that arrived."
    )
    return Table.of("Drawn worlds", ("planned way", "controller"), columns, entries, note)


def _clearance(runs: Rows) -> Estimate:
    return Estimate.of_runs([one.passage.clearance_m for one in runs if arrived(one)], median)


def _conditions(rows: Rows) -> Table:
    def where(one: WorldOutcome) -> str:
        labels = one.case.labels
        said = [labels[name] for name in ("plant", "surface", "sensors") if labels[name] not in ("mujoco", "default")]
        return ", ".join(said) or "as tuned"

    drivers = list(group(rows, lambda one: one.driver))
    columns: dict[str, Callable[[Rows], str]] = {}
    for name in drivers:
        columns[f"{name}: arrived"] = lambda runs, name=name: _of(runs, name, arrived)  # type: ignore[misc]
        columns[f"{name}: collided"] = lambda runs, name=name: _of(runs, name, collided)  # type: ignore[misc]
    entries = [((name,), runs) for name, runs in group(rows, where).items()]
    return Table.of("Robots, floors and sensors", ("condition",), columns, entries, "Drawn worlds of both kinds.")


def _of(runs: Rows, driver: str, counted: Callable[[WorldOutcome], bool]) -> str:
    own = [one for one in runs if one.driver == driver]
    return f"{sum(map(counted, own))}/{len(own)}"


def _crossings(rows: Rows) -> Table:
    columns: dict[str, Callable[[Rows], str]] = {
        "runs": lambda runs: str(len(runs)),
        "person known in time to stop": lambda runs: str(sum(one.stop_possible is True for one in runs)),
        "of these: touched while moving": lambda runs: str(_touched(runs, possible=True)),
        "of the others: touched while moving": lambda runs: str(_touched(runs, possible=False)),
        "walked into while standing": lambda runs: str(sum(one.passage.walked_into > 0 for one in runs)),
        "arrived [%]": lambda runs: interval(rate(runs, arrived)),
        "time over planned": lambda runs: estimate(lateness(runs), 2),
    }
    entries = [((driver,), runs) for driver, runs in group(rows, lambda one: one.driver).items()]
    note = (
        "Moving: faster than 0.02 m/s. In time: braking at the limits from when two looks at the person had arrived "
        "touches nobody, tried in the same run again; the others include persons who were never seen during the run."
    )
    return Table.of("A person crosses", ("controller",), columns, entries, note)


def _touched(runs: Rows, *, possible: bool) -> int:
    return sum(collided(one) for one in runs if (one.stop_possible is True) == possible)


def _named(rows: Rows) -> Table:
    entries = [
        ((world, driver), runs)
        for world, part in group(rows, lambda one: one.case.world).items()
        for driver, runs in group(part, lambda one: one.driver).items()
    ]
    columns: dict[str, Callable[[Rows], str]] = {
        "runs": lambda runs: str(len(runs)),
        "arrived": lambda runs: str(sum(map(arrived, runs))),
        "collided": lambda runs: str(sum(map(collided, runs))),
        "mean time [s]": lambda runs: number(_mean([one.passage.time_s for one in runs if arrived(one)]), 1),
        "least clearance [m]": lambda runs: number(min(one.passage.clearance_m for one in runs), 3),
        "stood, mean [s]": lambda runs: number(_mean([one.passage.standing_s for one in runs]), 1),
    }
    note = (
        "In “blocked” there is no way: it is to stand. Standing: also at the start and, without an arrival, in the end."
    )
    return Table.of("Named worlds", ("world", "controller"), columns, entries, note)


def _contacts(rows: Rows) -> Table:
    hit = [one for one in rows if collided(one)]
    shown = sorted(hit, key=lambda one: -one.passage.contact_speed_m_s)[:12]
    columns: dict[str, Callable[[WorldOutcome], str]] = {
        "seed": lambda one: str(one.case.seed),
        "speed [m/s]": lambda one: number(one.passage.contact_speed_m_s, 2),
    }
    entries = [((one.driver, one.case.world, one.case.surface, one.case.plant, one.ended), one) for one in shown]
    note = f"The hardest {len(shown)} of {len(hit)}."
    return Table.of("Contacts", ("controller", "world", "surface", "plant", "what"), columns, entries, note)


def _cost(rows: Rows) -> Table:
    columns: dict[str, Callable[[Rows], str]] = {
        "processor time of a run, mean [s]": lambda runs: number(_mean([one.processor_s for one in runs]), 2),
        "step p99, mean over runs [ms]": lambda runs: number(1e3 * _mean([one.step_p99 for one in runs]), 2),
    }
    entries = [((driver,), runs) for driver, runs in group(rows, lambda one: one.driver).items()]
    note = "Several runs at a time on a shared machine: step times are no benchmark."
    return Table.of("What it costs", ("controller",), columns, entries, note)


def said(rows: Rows, driver: str, most: int = 3) -> list[str]:
    """What a controller said most often at the end of runs in which it did not arrive."""
    words = Counter(one.message for one in rows if one.driver == driver and not arrived(one) and one.message)
    return [message for message, _ in words.most_common(most)]


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else float("nan")


def interval(of: Rate) -> str:
    """A rate in percent with its interval."""
    return f"{100 * of.share:.1f} [{100 * of.low:.1f}, {100 * of.high:.1f}]"


def estimate(of: Estimate, digits: int) -> str:
    """An estimate with its interval."""
    if not np.isfinite(of.value):
        return "-"
    return f"{of.value:.{digits}f} [{number(of.low, digits)}, {number(of.high, digits)}]"
