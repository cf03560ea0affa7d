"""Speed passport of a controller: proven speeds by surface, curvature and tolerance.

For each surface, curvature and tolerance, a bisection finds the maximum speed of a grid at which the robots of the
search stay within the tolerance. New robots then drive this speed. If too few of them stay within the tolerance,
further new robots drive the next lower speed. The error level of these tests is divided by the number of tries, so that
the confidence holds for the passing speed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import yaml

from diffdrive_mpc.bench.html_report.page import Axis, Chart, ConfigurationView, PageContents, PageWarning, Series
from diffdrive_mpc.bench.plain_values import plain
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import persistent_processes
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
from diffdrive_mpc_extras.proof.study import controller_factors

PASSPORT = "speed-passport.yaml"
"""File name of the passport, which `timing: smooth` reads."""
_OTHER_PATHS = ("trajectory", "timing", "scenario", "world", "top_speed", "scaled")
"""Campaign factors that a passport replaces, because it uses separate paths and no faults."""
_BATCH = 20
_HEAD = "# Speeds in m/s, curvatures in 1/m, tolerances in m: measured by diffdrive-mpc prove --tolerance.\n"


def read_tolerances(text: str) -> tuple[float, ...]:
    """Parse a text such as `0.01,0.02` to increasing numbers [m]; raises ValueError for any other text."""
    try:
        tolerances = tuple(sorted({float(part) for part in text.split(",")}))
    except ValueError as error:
        raise ValueError(f"--tolerance '{text}': give lengths in m with commas between them") from error
    if not all(0.0 < tolerance < math.inf for tolerance in tolerances):
        raise ValueError(f"--tolerance '{text}': each must be above zero")
    return tolerances


@dataclass
class SpeedSearch:
    """Search for one speed, and the test of the speed with new robots.

    Attributes
    ----------
    surface, curvature, tolerance
        Surface, curvature [1/m] and tolerance [m] of the speed.
    speeds
        Increasing grid of speeds [m/s].
    plan
        Numbers of robots and confidence.
    searched
        Rate of robots within the tolerance, by index of the speed.
    fresh
        Index of the speed and rate of new robots within the tolerance, for each try.
    """

    surface: str
    curvature: float
    tolerance: float
    speeds: Sequence[float]
    plan: PassportPlan
    searched: dict[int, Rate] = field(default_factory=dict)
    fresh: list[tuple[int, Rate]] = field(default_factory=list)
    _partial: tuple[int, int] = (0, 0)
    """Number of robots within the tolerance and number of driven robots, in an unfinished block."""

    @property
    def query(self) -> tuple[int, int, int] | None:
        """Next drives: index of the speed, block of robots (0: search) and its next robot; None at the end."""
        inside = [number for number, rate in self.searched.items() if self._is_proven(rate, 1)]
        low = max(inside, default=-1)
        high = min((number for number in self.searched if number > low), default=len(self.speeds))
        if high - low > 1:
            return (low + high) // 2, 0, self._partial[1]
        tries = len(self.fresh)
        if self.number is not None or tries == self.plan.tries or low < tries:
            return None
        return low - tries, 1 + tries, self._partial[1]

    @property
    def number(self) -> int | None:
        """Index of the maximum proven speed."""
        return next((number for number, rate in self.fresh if self._is_proven(rate, self.plan.tries)), None)

    @property
    def speed(self) -> float | None:
        """Maximum proven speed [m/s]."""
        return None if self.number is None else self.speeds[self.number]

    @property
    def too_fast(self) -> float | None:
        """Next speed of the grid, which is not proven [m/s]; None if the limits allow no higher speed."""
        number = -1 if self.number is None else self.number
        return self.speeds[number + 1] if number + 1 < len(self.speeds) else None

    def take(self, lateral: FloatArray) -> None:
        """Add the maximum |lateral| (n,) [m] of the drives of `query`.

        A block ends early if its remaining robots cannot reach the required share; this does not affect the confidence.
        """
        assert self.query is not None
        number, block, _ = self.query
        inside = self._partial[0] + int(np.count_nonzero(lateral <= self.tolerance))
        driven = self._partial[1] + len(lateral)
        size = block_size(self.plan, block)
        at_best = Rate.of_runs(inside + size - driven, size)
        if driven < size and self._is_proven(at_best, self.plan.tries if block else 1):
            self._partial = inside, driven
            return
        self._partial, rate = (0, 0), Rate.of_runs(inside, driven)
        if block:
            self.fresh.append((number, rate))
        else:
            self.searched[number] = rate

    def _is_proven(self, rate: Rate, tries: int) -> bool:
        return rate.at_least(1.0 - (1.0 - self.plan.confidence) / tries) >= self.plan.share


Key = tuple[str, float, int, int, int]
"""Surface, curvature [1/m], number of the speed, block of robots, first of them."""


def block_size(plan: PassportPlan, block: int) -> int:
    """Return the number of robots of a block."""
    return plan.proof_runs if block else plan.search_runs


def members(plan: PassportPlan, block: int, first: int) -> range:
    """Return the indices of one batch of robots, from the `first` of a block on, among all robots of a surface."""
    before = plan.search_runs + (block - 1) * plan.proof_runs if block else 0
    return range(before + first, before + min(first + _BATCH, block_size(plan, block)))


def measure(searches: Sequence[SpeedSearch], drive: Callable[[list[Key]], Mapping[Key, FloatArray]]) -> None:
    """Carry out all searches with shared drives; `drive` returns the maximum |lateral| (n,) [m]."""
    results: dict[Key, FloatArray] = {}
    while open_searches := [(search, query) for search in searches if (query := search.query) is not None]:
        keys = [(search.surface, search.curvature, *query) for search, query in open_searches]
        results |= drive([key for key in dict.fromkeys(keys) if key not in results])
        for (search, _), key in zip(open_searches, keys, strict=True):
            search.take(results[key])


@dataclass(frozen=True)
class MeasuredSpeeds:
    """Measured passport with all its drives."""

    searches: list[SpeedSearch]
    driven: list[CampaignRun]


class PassportStudy(Study[dict[str, list[Definition]], MeasuredSpeeds]):
    """Study of the speed passport of one controller; arguments as in `ProofStudy`, increasing `tolerances` [m]."""

    name = "passport"
    title = "Speed passport"
    shared = True

    def __init__(self, config: str, proof: Proof, place: CampaignPlace, tolerances: Sequence[float]) -> None:
        self._config, self._proof, self._place, self._tolerances = config, proof, place, tolerances

    def plan(self) -> dict[str, list[Definition]]:
        """Draw the robots of each surface: those of the search, followed by those of each try."""
        proof, plan = self._proof, self._proof.passport
        factors = {name: data for name, data in proof.factors.items() if name not in _OTHER_PATHS}
        robots = {}
        for name, floor in plan.surfaces.items():
            changes = {"sampler": "random", "draw_seed": plan.draw_seed, "factors": factors | plan.factors | floor}
            drawn = proof.model_copy(update=changes).definitions(plan.search_runs + plan.tries * plan.proof_runs)
            robots[name] = [robot.with_factors(controller_factors(self._config)) for robot in drawn]
        return robots

    def run(self, plan: dict[str, list[Definition]], jobs: int, bar: ProgressBar) -> MeasuredSpeeds:
        """Search and test the speeds; the paths are files in the folder of the place."""
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
        all_runs: list[CampaignRun] = []

        def drive(keys: list[Key]) -> Mapping[Key, FloatArray]:
            runs = {}
            for key in keys:
                surface, curvature, number, *robots = key
                path = folder / f"{curvature:g}-{number}.yaml"
                path.write_text(path_text(curvature, grids[curvature][number], spec, limits), encoding="utf-8")
                runs[key] = [plan[surface][k].with_factors({"trajectory": str(path)}) for k in members(spec, *robots)]
            outcomes = drive_all(
                [run for definitions in runs.values() for run in definitions], place, bar, "driving speeds"
            )
            all_runs.extend(outcomes)
            lateral = {outcome.definition: max_lateral(outcome) for outcome in outcomes}
            return {key: np.array([lateral[run] for run in definitions]) for key, definitions in runs.items()}

        with persistent_processes():
            measure(searches, drive)
        return MeasuredSpeeds(searches, all_runs)

    def report(self, results: MeasuredSpeeds, seconds: float) -> Report:  # noqa: ARG002 - not used
        """Return the report with the speeds, the test results, and the passport file."""
        spec, searches, text = self._proof.passport, results.searches, self._text(results.searches)
        claim = (
            f"At these speeds, at least {100 * spec.share:g} % of the robots stay within the tolerance on a straight "
            f"line and an arc to each side, with a confidence of {100 * spec.confidence:g} % for each speed. "
            "Paths with many turns or several classes of curvature may have larger errors."
        )
        remedy = "increase the tolerance, or avoid such turns: a path that needs them is rejected"
        warnings = [
            PageWarning(f"{_name(search)}: no speed is proven.", remedy) for search in searches if search.speed is None
        ]
        return Report(
            size=f"{len(results.driven)} runs",
            meta={"controller": Path(self._config).name, "campaign": self._proof.description},
            content={"speeds": [_row(search) for search in searches]},
            facts=[
                f"{Path(self._config).name}: {self._proof.description}, without faults.",
                claim,
                _cost(results.driven),
            ],
            notes=["Error: maximum lateral distance of the true position from the timed path over the whole drive."],
            tables=[self._speeds(searches), self._evidence(searches)],
            shown=PageContents(
                summary=[claim],
                views=[_chart(surface, searches) for surface in spec.surfaces],
                warnings=warnings,
                configurations=[ConfigurationView(f"{PASSPORT} (YAML)", text)],
            ),
            files={PASSPORT: text},
        )

    def _text(self, searches: Sequence[SpeedSearch]) -> str:
        """Format the passport as YAML."""
        spec = self._proof.passport
        rows = [
            PassportRow(
                surface=surface,
                tolerance=tolerance,
                speeds=[
                    search.speed for search in searches if (search.surface, search.tolerance) == (surface, tolerance)
                ],
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
        by_place = {(search.surface, search.curvature, search.tolerance): search for search in searches}
        rows = [
            (
                surface,
                _radius_text(curvature),
                *(_speed(by_place[surface, curvature, tolerance].speed) for tolerance in self._tolerances),
            )
            for surface in self._proof.passport.surfaces
            for curvature in self._proof.passport.curvatures
        ]
        columns = ("floor", "radius", *(f"within {1e3 * tolerance:g} mm [m/s]" for tolerance in self._tolerances))
        note = "Maximum proven speed of the grid; -: no speed is proven."
        return Table("Speeds", columns, tuple(rows), text_columns=2, note=note)

    def _evidence(self, searches: Sequence[SpeedSearch]) -> Table:
        spec = self._proof.passport
        return Table.build(
            "Test results",
            ("floor", "radius", "tolerance"),
            {
                "speed [m/s]": lambda search: _speed(search.speed),
                "not proven at [m/s]": lambda search: _speed(search.too_fast),
                "within, search": lambda search: (
                    "-" if search.number is None else _count(search.searched.get(search.number))
                ),
                "within, new": lambda search: _count(search.fresh[-1][1]) if search.fresh else "-",
                "share [%]": lambda search: f"{100 * search.fresh[-1][1].share:.1f}" if search.fresh else "-",
                "95 % interval [%]": lambda search: (
                    _interval(search.fresh[-1][1])
                    if search.fresh and search.fresh[-1][1].of == spec.proof_runs
                    else "-"
                ),
                "tries": lambda search: str(len(search.fresh)),
            },
            [
                ((search.surface, _radius_text(search.curvature), f"{1e3 * search.tolerance:g} mm"), search)
                for search in searches
            ],
            f"Search: {spec.search_runs} robots at each speed. New: {spec.proof_runs} others in each try; intervals "
            f"by Clopper and Pearson. A speed is proven if its one-sided lower bound at "
            f"{100 * (1 - (1 - spec.confidence) / spec.tries):.1f} % is at least {100 * spec.share:g} %; there are "
            f"{spec.tries} tries. Not proven at: next speed of the grid; -: the limits allow no higher speed. "
            "A try that can no longer pass ends early and has no interval.",
        )


def max_lateral(run: CampaignRun) -> float:
    """Return the maximum |lateral| of a drive [m]; infinity if the drive was not completed."""
    return run.number("lateral_max_m") if run.row["completed"] is True else math.inf


def speed_grid(curvature: float, limits: TrajectoryLimits, shares: Sequence[float]) -> list[float]:
    """Return speeds [m/s] for a curvature [1/m]: `shares` of the maximum under `limits`, rounded down to mm/s."""
    radius = 1.0 / curvature if curvature else math.inf
    max_speed = min(limits.v, limits.omega * radius, math.sqrt(limits.lateral_acceleration * radius))
    return [math.floor(1e3 * share * max_speed + 1e-6) / 1e3 for share in shares]


def path_text(curvature: float, speed: float, spec: PassportPlan, limits: TrajectoryLimits) -> str:
    """Format a trajectory file: a straight line, an arc to each side and a straight line, with smooth timing."""
    # The straight lines are long enough to reach the speed.
    straight = {"v": speed, "omega": 0.0, "duration": spec.straight + speed / limits.v_acceleration}
    left, right = ({"v": speed, "omega": sign * speed * curvature, "duration": spec.arc} for sign in (1, -1))
    return yaml.safe_dump({"timing": "smooth", "segments": [straight, left, right, straight]})


def _cost(driven: Sequence[CampaignRun]) -> str:
    total = sum(run.number(f"{TIME}processor_s") for run in driven)
    return f"{len(driven)} drives took {total / 60:.1f} minutes of processor time."


def _row(search: SpeedSearch) -> dict[str, object]:
    rates = {"searched": search.searched, "fresh": dict(search.fresh)}
    return {
        "surface": search.surface,
        "curvature": search.curvature,
        "tolerance_m": search.tolerance,
        "speed": search.speed,
        **{
            name: {f"{search.speeds[number]:g}": plain(rate) for number, rate in counts.items()}
            for name, counts in rates.items()
        },
    }


def _chart(surface: str, searches: Sequence[SpeedSearch]) -> Chart:
    on_surface = [search for search in searches if search.surface == surface]
    series = []
    for k, tolerance in enumerate(dict.fromkeys(search.tolerance for search in on_surface)):
        rows = [search for search in on_surface if search.tolerance == tolerance]
        curvatures, speeds = [search.curvature for search in rows], [search.speed for search in rows]
        series.append(Series(f"{1e3 * tolerance:g} mm", curvatures, speeds, k))
    return Chart(f"Maximum speed, surface {surface}", Axis("curvature [1/m]"), Axis("speed [m/s]"), series)


def _name(search: SpeedSearch) -> str:
    return f"{search.surface}, {_radius_text(search.curvature)}, {1e3 * search.tolerance:g} mm"


def _radius_text(curvature: float) -> str:
    return f"{1 / curvature:.3g} m" if curvature else "straight"


def _speed(speed: float | None) -> str:
    return "-" if speed is None else f"{speed:.3f}"


def _count(rate: Rate | None) -> str:
    return "-" if rate is None else f"{rate.count} of {rate.of}"


def _interval(rate: Rate) -> str:
    return f"{100 * rate.low:.1f} to {100 * rate.high:.1f}"
