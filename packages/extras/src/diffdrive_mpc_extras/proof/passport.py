"""The speed passport of a controller: how fast which robots may drive which curvature within a tolerance.

For each floor, curvature and tolerance a bisection gives the greatest speed of a grid at which the robots of the search
stay inside. Robots that played no part in it then drive that speed; where too few of them stay inside, others drive the
next slower one. The level of these tests is divided by the number of tries, so the confidence holds for what passes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import yaml

from diffdrive_mpc.bench.html_report.page import Axis, Chart, ConfigurationView, Series, Shown, Warned
from diffdrive_mpc.bench.plain_values import plain
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import lasting_processes
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.speed_passport import PassportRow, SpeedPassport
from diffdrive_mpc_extras.campaign.definition import Definition
from diffdrive_mpc_extras.campaign.drive import TIME
from diffdrive_mpc_extras.campaign.engine import CampaignPlace, CampaignRun, drive_all
from diffdrive_mpc_extras.campaign.rates import Rate
from diffdrive_mpc_extras.proof.proof_file import PassportPlan, Proof
from diffdrive_mpc_extras.proof.study import told_of

PASSPORT = "speed-passport.yaml"
"""What `timing: smooth` takes."""
_OTHER_PATHS = ("trajectory", "timing", "scenario", "world", "top_speed", "scaled")
"""Factors of a campaign that a passport does without: it has paths of its own, and no faults."""
_AT_A_TIME = 20
_HEAD = "# Speeds in m/s, curvatures in 1/m, tolerances in m: measured by diffdrive-mpc prove --tolerance.\n"


def read_tolerances(text: str) -> tuple[float, ...]:
    """`0.01,0.02` as rising numbers [m]; raises ValueError where it is anything else."""
    try:
        tolerances = tuple(sorted({float(part) for part in text.split(",")}))
    except ValueError as error:
        raise ValueError(f"--tolerance '{text}': give lengths in m with commas between them") from error
    if not all(0.0 < one < math.inf for one in tolerances):
        raise ValueError(f"--tolerance '{text}': each has to be above zero")
    return tolerances


@dataclass
class SpeedSearch:
    """The search for one speed, and its proof.

    Attributes
    ----------
    surface, curvature, tolerance
        What it is for [1/m, m].
    speeds
        The grid [m/s], rising.
    plan
        How often, and how sure.
    searched
        How many stayed inside, by number of the speed.
    fresh
        The same of the fresh robots, in the order of the tries.
    """

    surface: str
    curvature: float
    tolerance: float
    speeds: Sequence[float]
    plan: PassportPlan
    searched: dict[int, Rate] = field(default_factory=dict)
    fresh: list[tuple[int, Rate]] = field(default_factory=list)
    _begun: tuple[int, int] = (0, 0)
    """Inside, and driven, of a block that is not done."""

    @property
    def query(self) -> tuple[int, int, int] | None:
        """What to drive next: number of a speed, block of robots (0: search), first of them; None at the end."""
        inside = [number for number, rate in self.searched.items() if self._shows(rate, 1)]
        low = max(inside, default=-1)
        high = min((number for number in self.searched if number > low), default=len(self.speeds))
        if high - low > 1:
            return (low + high) // 2, 0, self._begun[1]
        tries = len(self.fresh)
        if self.number is not None or tries == self.plan.tries or low < tries:
            return None
        return low - tries, 1 + tries, self._begun[1]

    @property
    def number(self) -> int | None:
        """Number of the greatest speed that is proven."""
        return next((number for number, rate in self.fresh if self._shows(rate, self.plan.tries)), None)

    @property
    def speed(self) -> float | None:
        """That speed [m/s]."""
        return None if self.number is None else self.speeds[self.number]

    @property
    def too_fast(self) -> float | None:
        """The next speed of the grid, which was not shown to hold; None where the limits allow no greater one."""
        number = -1 if self.number is None else self.number
        return self.speeds[number + 1] if number + 1 < len(self.speeds) else None

    def take(self, lateral: FloatArray) -> None:
        """Take the largest |lateral| (n,) [m] of the drives that `query` asked for.

        A block ends early where so many are outside that the rest cannot show the share: no level depends on that.
        """
        assert self.query is not None
        number, block, _ = self.query
        inside = self._begun[0] + int(np.count_nonzero(lateral <= self.tolerance))
        driven = self._begun[1] + len(lateral)
        whole = block_size(self.plan, block)
        at_best = Rate.of_runs(inside + whole - driven, whole)
        if driven < whole and self._shows(at_best, self.plan.tries if block else 1):
            self._begun = inside, driven
            return
        self._begun, rate = (0, 0), Rate.of_runs(inside, driven)
        if block:
            self.fresh.append((number, rate))
        else:
            self.searched[number] = rate

    def _shows(self, rate: Rate, tries: int) -> bool:
        return rate.at_least(1.0 - (1.0 - self.plan.confidence) / tries) >= self.plan.share


Key = tuple[str, float, int, int, int]
"""Surface, curvature [1/m], number of the speed, block of robots, first of them."""


def block_size(plan: PassportPlan, block: int) -> int:
    """Robots of a block."""
    return plan.proof_runs if block else plan.search_runs


def members(plan: PassportPlan, block: int, first: int) -> range:
    """Numbers of the robots that are driven at a time, from the `first` of a block, among all robots of a floor."""
    before = plan.search_runs + (block - 1) * plan.proof_runs if block else 0
    return range(before + first, before + min(first + _AT_A_TIME, block_size(plan, block)))


def measure(searches: Sequence[SpeedSearch], drive: Callable[[list[Key]], Mapping[Key, FloatArray]]) -> None:
    """Carry out all searches, whose drives serve all tolerances; `drive` gives the largest |lateral| (n,) [m]."""
    driven: dict[Key, FloatArray] = {}
    while open_searches := [(one, query) for one in searches if (query := one.query) is not None]:
        keys = [(one.surface, one.curvature, *query) for one, query in open_searches]
        driven |= drive([key for key in dict.fromkeys(keys) if key not in driven])
        for (one, _), key in zip(open_searches, keys, strict=True):
            one.take(driven[key])


@dataclass(frozen=True)
class MeasuredSpeeds:
    """A passport as it was measured, and all drives that it took."""

    searches: list[SpeedSearch]
    driven: list[CampaignRun]


class PassportStudy(Study[dict[str, list[Definition]], MeasuredSpeeds]):
    """Measure the speed passport of one controller; arguments as of `ProofStudy`, `tolerances` in m, rising."""

    name = "passport"
    title = "Speed passport"
    shared = True

    def __init__(self, config: str, proof: Proof, place: CampaignPlace, tolerances: Sequence[float]) -> None:
        self._config, self._proof, self._place, self._tolerances = config, proof, place, tolerances

    def plan(self) -> dict[str, list[Definition]]:
        """The robots of each floor: first those of the search, then those of each try."""
        proof, plan = self._proof, self._proof.passport
        factors = {name: data for name, data in proof.factors.items() if name not in _OTHER_PATHS}
        robots = {}
        for name, floor in plan.surfaces.items():
            changes = {"sampler": "random", "draw_seed": plan.draw_seed, "factors": factors | plan.factors | floor}
            drawn = proof.model_copy(update=changes).definitions(plan.search_runs + plan.tries * plan.proof_runs)
            robots[name] = [robot.changed(told_of(self._config)) for robot in drawn]
        return robots

    def run(self, plan: dict[str, list[Definition]], jobs: int, bar: ProgressBar) -> MeasuredSpeeds:
        """Search and prove; paths are files in the folder of the place."""
        spec, place = self._proof.passport, replace(self._place, jobs=jobs)
        limits = TrajectoryLimits.of_controller(load_config(self._config).limits)
        grids = {curvature: speed_grid(curvature, limits, spec.speeds) for curvature in spec.curvatures}
        searches = [
            SpeedSearch(surface, curvature, tolerance, grids[curvature], spec)
            for surface in spec.surfaces
            for tolerance in self._tolerances
            for curvature in spec.curvatures
        ]
        folder = place.folder / "paths"
        folder.mkdir(parents=True, exist_ok=True)
        every: list[CampaignRun] = []

        def drive(keys: list[Key]) -> Mapping[Key, FloatArray]:
            runs = {}
            for key in keys:
                surface, curvature, number, *robots = key
                path = folder / f"{curvature:g}-{number}.yaml"
                path.write_text(path_text(curvature, grids[curvature][number], spec, limits), encoding="utf-8")
                runs[key] = [plan[surface][k].changed({"trajectory": str(path)}) for k in members(spec, *robots)]
            outcomes = drive_all([run for of in runs.values() for run in of], place, bar, "driving speeds")
            every.extend(outcomes)
            lateral = {one.definition: largest_lateral(one) for one in outcomes}
            return {key: np.array([lateral[run] for run in of]) for key, of in runs.items()}

        with lasting_processes():
            measure(searches, drive)
        return MeasuredSpeeds(searches, every)

    def report(self, results: MeasuredSpeeds, seconds: float) -> Report:  # noqa: ARG002 - its tables say it
        """The speeds, what stands behind them, and the passport as a file."""
        spec, searches, text = self._proof.passport, results.searches, self._text(results.searches)
        words = (
            f"At these speeds at least {100 * spec.share:g} % of the robots stay within the tolerance "
            f"on a straight line and an arc to each side, each with a confidence of {100 * spec.confidence:g} %. "
            "A path with many turns or several classes of curvature may do worse."
        )
        remedy = "allow more, or leave out such turns: a path that needs them is refused"
        warnings = [Warned(f"{_name(one)}: no speed is proven.", remedy) for one in searches if one.speed is None]
        return Report(
            counted=f"{len(results.driven)} runs",
            meta={"controller": Path(self._config).name, "campaign": self._proof.description},
            content={"speeds": [_row(one) for one in searches]},
            facts=[
                f"{Path(self._config).name}: {self._proof.description}, without faults.",
                words,
                _cost(results.driven),
            ],
            notes=["Error: largest distance of the true position to either side of the timed path in the whole drive."],
            tables=[self._speeds(searches), self._evidence(searches)],
            shown=Shown(
                summary=[words],
                views=[_chart(surface, searches) for surface in spec.surfaces],
                warnings=warnings,
                configurations=[ConfigurationView(f"{PASSPORT} (YAML)", text)],
            ),
            files={PASSPORT: text},
        )

    def _text(self, searches: Sequence[SpeedSearch]) -> str:
        """The passport as YAML."""
        spec = self._proof.passport
        rows = [
            PassportRow(
                surface=surface,
                tolerance=tolerance,
                speeds=[one.speed for one in searches if (one.surface, one.tolerance) == (surface, tolerance)],
            )
            for surface in spec.surfaces
            for tolerance in self._tolerances
        ]
        passport = SpeedPassport(
            description=f"{Path(self._config).name}: {self._proof.description}, without faults",
            share=spec.share,
            confidence=spec.confidence,
            curvatures=list(spec.curvatures),
            rows=rows,
        )
        return _HEAD + yaml.safe_dump(passport.model_dump(), sort_keys=False, default_flow_style=None, width=120)

    def _speeds(self, searches: Sequence[SpeedSearch]) -> Table:
        by_place = {(one.surface, one.curvature, one.tolerance): one for one in searches}
        rows = [
            (surface, _words(curvature), *(_speed(by_place[surface, curvature, one].speed) for one in self._tolerances))
            for surface in self._proof.passport.surfaces
            for curvature in self._proof.passport.curvatures
        ]
        columns = ("floor", "radius", *(f"within {1e3 * one:g} mm [m/s]" for one in self._tolerances))
        note = "Greatest speed of a grid; -: none is proven."
        return Table("Speeds", columns, tuple(rows), text_columns=2, note=note)

    def _evidence(self, searches: Sequence[SpeedSearch]) -> Table:
        spec = self._proof.passport
        return Table.build(
            "What stands behind them",
            ("floor", "radius", "tolerance"),
            {
                "speed [m/s]": lambda one: _speed(one.speed),
                "not shown at [m/s]": lambda one: _speed(one.too_fast),
                "inside, search": lambda one: "-" if one.number is None else _count(one.searched.get(one.number)),
                "inside, fresh": lambda one: _count(one.fresh[-1][1]) if one.fresh else "-",
                "share [%]": lambda one: f"{100 * one.fresh[-1][1].share:.1f}" if one.fresh else "-",
                "95 % interval [%]": lambda one: (
                    _interval(one.fresh[-1][1]) if one.fresh and one.fresh[-1][1].of == spec.proof_runs else "-"
                ),
                "tries": lambda one: str(len(one.fresh)),
            },
            [((one.surface, _words(one.curvature), f"{1e3 * one.tolerance:g} mm"), one) for one in searches],
            f"Search: {spec.search_runs} robots at each speed. Fresh: {spec.proof_runs} others in each try; intervals "
            f"by Clopper and Pearson. A speed is proven where {100 * spec.share:g} % is at most its lower bound, "
            f"one-sided with {100 * (1 - (1 - spec.confidence) / spec.tries):.1f} %, as there are {spec.tries} tries. "
            "Not shown at: the next speed of the grid; -: limits allow no greater one. "
            "A try that cannot pass any more ends early, and has no interval.",
        )


def largest_lateral(run: CampaignRun) -> float:
    """Largest |lateral| of a drive [m]; infinite where it did not come to its end."""
    return run.number("lateral_max_m") if run.row["completed"] is True else math.inf


def speed_grid(curvature: float, limits: TrajectoryLimits, shares: Sequence[float]) -> list[float]:
    """Speeds [m/s] for a curvature [1/m]: `shares` of the greatest that `limits` allow, down to whole mm/s."""
    radius = 1.0 / curvature if curvature else math.inf
    greatest = min(limits.v, limits.omega * radius, math.sqrt(limits.lateral_acceleration * radius))
    return [math.floor(1e3 * share * greatest + 1e-6) / 1e3 for share in shares]


def path_text(curvature: float, speed: float, spec: PassportPlan, limits: TrajectoryLimits) -> str:
    """A trajectory file: a straight, an arc to the left, one to the right and a straight, rounded by smooth timing."""
    # The straights are so long that the speed is reached on them.
    straight = {"v": speed, "omega": 0.0, "duration": spec.straight + speed / limits.v_acceleration}
    left, right = ({"v": speed, "omega": sign * speed * curvature, "duration": spec.arc} for sign in (1, -1))
    return yaml.safe_dump({"timing": "smooth", "segments": [straight, left, right, straight]})


def _cost(driven: Sequence[CampaignRun]) -> str:
    total = sum(run.number(f"{TIME}processor_s") for run in driven)
    return f"{len(driven)} drives took {total / 60:.1f} minutes of processor time."


def _row(one: SpeedSearch) -> dict[str, object]:
    rates = {"searched": one.searched, "fresh": dict(one.fresh)}
    return {
        "surface": one.surface,
        "curvature": one.curvature,
        "tolerance_m": one.tolerance,
        "speed": one.speed,
        **{name: {f"{one.speeds[number]:g}": plain(rate) for number, rate in of.items()} for name, of in rates.items()},
    }


def _chart(surface: str, searches: Sequence[SpeedSearch]) -> Chart:
    own = [one for one in searches if one.surface == surface]
    series = []
    for k, tolerance in enumerate(dict.fromkeys(one.tolerance for one in own)):
        rows = [one for one in own if one.tolerance == tolerance]
        curvatures, speeds = [one.curvature for one in rows], [one.speed for one in rows]
        series.append(Series(f"{1e3 * tolerance:g} mm", curvatures, speeds, k))
    return Chart(f"Greatest speed, {surface} floor", Axis("curvature [1/m]"), Axis("speed [m/s]"), series)


def _name(one: SpeedSearch) -> str:
    return f"{one.surface}, {_words(one.curvature)}, {1e3 * one.tolerance:g} mm"


def _words(curvature: float) -> str:
    return f"{1 / curvature:.3g} m" if curvature else "straight"


def _speed(speed: float | None) -> str:
    return "-" if speed is None else f"{speed:.3f}"


def _count(rate: Rate | None) -> str:
    return "-" if rate is None else f"{rate.count} of {rate.of}"


def _interval(rate: Rate) -> str:
    return f"{100 * rate.low:.1f} to {100 * rate.high:.1f}"
