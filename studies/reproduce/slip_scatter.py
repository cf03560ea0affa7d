"""How far the learned slip predicts, and whether it knows how far: P4's scatter of poses after two seconds.

P4: Ordonez et al., 2017, section 4.2 and Figures 12 to 15. There each point is the error of a pose that was predicted
from commands over 2 s, with the slip calibrated and without; an ellipse is drawn from the points, and one from the
covariances that the calibrated model predicts. Here the filter learns slip in the first part of a drive, and from then
on its belief is carried on over such a time again and again, under the commands that were sent.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import ahead_and_left
from diffdrive_mpc.models.slip_laws import POLYNOMIAL
from diffdrive_mpc.mpc import Controller, load_config
from diffdrive_mpc.mpc.estimate import Belief
from diffdrive_mpc.mpc.problem.slip import PRIORS, Slip
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.segments import lay_segments
from diffdrive_mpc.sim import make_plant
from diffdrive_mpc.sim.plants.surface import load_surface
from diffdrive_mpc_extras.excitation.slip_excitation import slip_excitation
from studies.reproduce.published import PaperFinding, Published, ScatterFloor, ScatterStudy

_INSIDE = 0.95
"""Share of the errors that an ellipse should hold."""
_SOURCE = "P4, section 4.2, Figures 12 to 14"


@dataclass(frozen=True)
class Foresight:
    """Errors of n foreseen poses, and how sure each was: along, to the left of its heading [m], and in heading [rad].

    Attributes
    ----------
    errors
        (n, 3) true pose less the foreseen one.
    covariances
        (n, 3, 3) of the same, as foreseen.
    """

    errors: FloatArray
    covariances: FloatArray

    @property
    def nees(self) -> FloatArray:
        """(n,) squared errors over their covariance, divided by three: 1 on average where the covariance is right."""
        solved = np.linalg.solve(self.covariances, self.errors[..., None])[..., 0]
        return np.asarray((self.errors * solved).sum(axis=1) / 3)

    @property
    def inside(self) -> float:
        """Share of the places inside the ellipse that should hold 95 % of them."""
        places, shapes = self.errors[:, :2], self.covariances[:, :2, :2]
        squares = (places * np.linalg.solve(shapes, places[..., None])[..., 0]).sum(axis=1)
        return float(np.mean(squares < stats.chi2(2).ppf(_INSIDE)))

    def scaled(self, factors: FloatArray) -> Foresight:
        """The same with deviations times `factors` (3,)."""
        return Foresight(self.errors, self.covariances * np.outer(factors, factors))

    @property
    def rms(self) -> FloatArray:
        """(3,) root mean square of the errors."""
        return np.asarray(np.sqrt(np.mean(self.errors**2, axis=0)))

    @property
    def foreseen(self) -> FloatArray:
        """(3,) root mean square of the deviations that were foreseen."""
        return np.asarray(np.sqrt(np.mean(np.diagonal(self.covariances, axis1=1, axis2=2), axis=0)))


@dataclass(frozen=True)
class SlipScatter:
    """What one drive on one floor showed.

    Attributes
    ----------
    floor, drifts
        Where, and by what the drifts of slip were multiplied.
    nominal, learned
        Foreseen with no slip at all, and with the slip that was learned by then.
    scaled
        The latter, its deviations times the factors by which those of the time before were wrong.
    by_slip
        (3,) root mean square of the deviations that what is not known of slip adds.
    coefficients, deviations
        (9,) the nine terms of `models.slip_laws.polynomial_twist` as learned in the end, and their deviations.
    truth
        (9,) those of the floor, where it is such a polynomial.
    paths
        (K, 2) [m] the true path over a longer time, and that from commands alone without slip and with it.
    """

    floor: str
    drifts: float
    nominal: Foresight
    learned: Foresight
    scaled: Foresight
    by_slip: FloatArray
    coefficients: FloatArray
    deviations: FloatArray
    truth: FloatArray | None
    paths: Mapping[str, FloatArray]


TRUE, NOMINAL, LEARNED = "driven", "no slip", "learned slip"


@dataclass(frozen=True)
class _Driven:
    """Ticks (K,) of a drive: true poses, commands, and the beliefs at some of them by number."""

    poses: FloatArray
    commands: FloatArray
    beliefs: Mapping[int, Belief]


def scatter_of(study: ScatterStudy, floor: ScatterFloor, drifts: float, seed: int) -> SlipScatter:
    """Learn on one floor, then foresee again and again; drifts of slip are multiplied by `drifts`."""
    controller = Controller(load_config("ssm", _settings(study, drifts)))
    dt = controller.config.sample_time
    ahead, longer, settled, first = (
        round(time / dt) for time in (study.horizon, study.path, study.settling, study.learning)
    )
    driven = _drive(study, floor, controller, seed, range(settled, round(study.duration / dt), ahead))
    before = [k for k in driven.beliefs if k + ahead <= first]
    starts = [k for k in driven.beliefs if k >= first and k + ahead < len(driven.poses)]

    def predict_from(starts: Sequence[int], change: Callable[[Belief], Belief] = lambda belief: belief) -> Foresight:
        misses = [_missed(controller, change(driven.beliefs[k]), driven, k, k + ahead) for k in starts]
        return Foresight(np.array([error for error, _ in misses]), np.array([shape for _, shape in misses]))

    learned, earlier = predict_from(starts), predict_from(before)
    certain = predict_from(starts, lambda belief: belief.with_slip(belief.slip))
    added = np.mean(np.diagonal(learned.covariances - certain.covariances, axis1=1, axis2=2), axis=0)
    last = driven.beliefs[starts[-1]]
    terms = load_surface(floor.surface).slip.polynomial if floor.plant.startswith("model:") else None
    return SlipScatter(
        floor.name,
        drifts,
        predict_from(starts, lambda belief: belief.with_slip(Slip())),
        learned,
        learned.scaled(earlier.rms / earlier.foreseen),
        np.sqrt(np.maximum(added, 0.0)),
        last.slip.polynomial,
        np.sqrt(np.diag(last.polynomial_covariance)),
        None if terms is None else np.array(terms.coefficients),
        _paths(controller, driven, starts[0], longer),
    )


def _settings(study: ScatterStudy, drifts: float) -> dict[str, float]:
    """Of the filter: what the study says, and drifts of slip that are those of the configuration times `drifts`."""
    usual = load_config("ssm").estimator
    scaled = {f"{name}_drift": drifts * usual.drift(name) for name in PRIORS}
    return {f"estimator.{name}": value for name, value in {**study.estimator, **scaled}.items()}


def _drive(study: ScatterStudy, floor: ScatterFloor, controller: Controller, seed: int, kept: range) -> _Driven:
    """Along the drive that tells the nine terms apart, measured by the usual sensors."""
    segments = slip_excitation(study.side, study.duration, study.v, study.yaw_rate)
    reference = lay_segments(segments, TrajectoryLimits.of_robot(), name="slip scatter")
    plant = make_plant(floor.plant, floor.surface, seed=seed)
    plant.reset(reference.sample([0.0]).pose[0])
    controller.start(reference, plant.time)
    poses, commands, beliefs = [], [], {}
    for k in range(kept.stop):
        poses.append(plant.true_pose)
        step = controller.step(plant.time, plant.measure())
        if k in kept:
            beliefs[k] = controller.belief
        commands.append(step.command)
        plant.advance(step.command)
    return _Driven(np.array(poses), np.array(commands), beliefs)


def _missed(
    controller: Controller, belief: Belief, driven: _Driven, first: int, stop: int
) -> tuple[FloatArray, FloatArray]:
    """Error (3,) and covariance (3, 3) of the pose at `stop`, as foreseen at `first`, in the frame of its heading."""
    predicted = controller.predict_belief(belief, driven.commands[first:stop])
    gap, theta = driven.poses[stop] - predicted.pose, predicted.pose[2]
    turn = np.eye(3)
    turn[:2, :2] = np.stack(ahead_and_left(np.eye(2), theta))
    heading = (gap[2] + np.pi) % (2 * np.pi) - np.pi
    return np.array([*ahead_and_left(gap, theta), heading]), turn @ predicted.pose_covariance @ turn.T


def _paths(controller: Controller, driven: _Driven, first: int, samples: int) -> dict[str, FloatArray]:
    """Where the robot drove, and where it should have been by commands alone."""
    stop = min(first + samples, len(driven.commands))
    paths = {TRUE: driven.poses[first:stop, :2]}
    begin = driven.beliefs[first]
    for name, belief in ((NOMINAL, begin.with_slip(Slip())), (LEARNED, begin)):
        now, places = belief, []
        for command in driven.commands[first:stop]:
            places.append(now.pose[:2])
            now = controller.predict_belief(now, [command])
        paths[name] = np.array(places)
    return paths


def _groups(results: Sequence[SlipScatter]) -> dict[tuple[str, float], list[SlipScatter]]:
    groups: dict[tuple[str, float], list[SlipScatter]] = {}
    for result in results:
        groups.setdefault((result.floor, result.drifts), []).append(result)
    return groups


def pooled(results: Sequence[SlipScatter], name: str) -> Foresight:
    """All that the drives of `results` foresaw, `nominal` or `learned`."""
    parts = [getattr(result, name) for result in results]
    return Foresight(np.concatenate([p.errors for p in parts]), np.concatenate([p.covariances for p in parts]))


def slip_scatter_tables(results: Sequence[SlipScatter], horizon: float) -> list[Table]:
    """Errors and what was foreseen of them by floor and drifts, and the terms that were learned."""
    rows, terms = [], []
    for (floor, drifts), group in _groups(results).items():
        nominal, learned, scaled = (pooled(group, name) for name in ("nominal", "learned", "scaled"))
        by_slip = np.sqrt(np.mean([result.by_slip**2 for result in group], axis=0))
        rows.append(
            (
                floor,
                _times(drifts),
                str(len(learned.errors)),
                *(_triple(values) for values in (nominal.rms, learned.rms, learned.foreseen, by_slip)),
                *_consistent(learned),
                _triple(scaled.foreseen),
                *_consistent(scaled),
            )
        )
        truth = group[0].truth
        if truth is not None:
            coefficients = np.mean([result.coefficients for result in group], axis=0)
            sure = np.sqrt(np.mean([result.deviations**2 for result in group], axis=0))
            if drifts == results[0].drifts:
                terms.append((floor, "true", *(f"{1e3 * value:.1f}" for value in truth)))
            cells = (f"{1e3 * mean:.1f} ± {1e3 * one:.1f}" for mean, one in zip(coefficients, sure, strict=True))
            terms.append((floor, f"learned, drifts {_times(drifts)}", *cells))
    shares = ("inside [%]", "NEES")
    scatter = Table(
        "Scatter of foreseen poses",
        (
            *("floor", "drifts of slip", "points", "no slip: RMS", "learned: RMS", "foreseen", "of that by slip"),
            *(*shares, "scaled: foreseen", *(f"scaled: {share}" for share in shares)),
        ),
        tuple(rows),
        text_columns=2,
        note=f"Pose {horizon:g} s ahead, from the commands that were sent: true less foreseen, along and to the left "
        "of the foreseen heading [mm] and in heading [mrad]; all drives together. Foreseen: root mean square of the "
        "filter's own deviations; of that by slip: what is not known of slip. Scaled: times the factors by which they "
        "were wrong in the time before. Inside: of the places, in the ellipse that should hold "
        f"{100 * _INSIDE:.0f} %. NEES: of all three, 1 where the covariance is right, less where the filter is too "
        "modest. P4 has this in its Figures 12 to 14, without numbers.",
    )
    note = "Times 1e-3, after the whole drive: mean over drives, and the filter's own standard deviation."
    return [
        scatter,
        *([Table("Learned terms", ("floor", "what", *POLYNOMIAL), tuple(terms), 2, note)] if terms else []),
    ]


def _consistent(values: Foresight) -> tuple[str, str]:
    return f"{100 * values.inside:.0f}", f"{values.nees.mean():.2f}"


def _times(drifts: float) -> str:
    return "as usual" if drifts == 1 else f"times {drifts:g}"


def _triple(values: FloatArray) -> str:
    return ", ".join(f"{1e3 * value:.1f}" for value in values)


def slip_scatter_findings(results: Sequence[SlipScatter], published: Published) -> list[PaperFinding]:
    """Whether learning helps, and whether what is foreseen agrees with what comes; one verdict for each floor."""
    findings = []
    for drifts in dict.fromkeys(result.drifts for result in results):
        groups = {floor: group for (floor, scale), group in _groups(results).items() if scale == drifts}
        nominal, learned, scaled = (
            [pooled(group, name) for group in groups.values()] for name in ("nominal", "learned", "scaled")
        )
        where = f"drifts {_times(drifts)}; {', '.join(groups)}"
        if drifts == results[0].drifts:
            findings += [_learning_helps(learned, nominal, where), _ellipse_holds(scaled, where, published)]
        findings.append(_corresponds(learned, "", where, published))
        findings.append(_corresponds(scaled, ", scaled by the errors before,", where, published))
    return findings


def _learning_helps(learned: Sequence[Foresight], nominal: Sequence[Foresight], where: str) -> PaperFinding:
    pairs = list(zip(learned, nominal, strict=True))
    return PaperFinding(
        f"with learned slip foreseen poses are nearer than without, along, across and in heading ({where})",
        _SOURCE,
        "seen in the figures",
        "; ".join(f"{_triple(one.rms)} against {_triple(other.rms)}" for one, other in pairs) + " (RMS; mm, mm, mrad)",
        tuple(bool((one.rms < other.rms).all()) for one, other in pairs),
    )


def _corresponds(values: Sequence[Foresight], how: str, where: str, published: Published) -> PaperFinding:
    factor = published.rules.corresponds
    ratios = [(value.foreseen / value.rms)[:2] for value in values]
    return PaperFinding(
        f"foreseen deviations{how} are those of the errors along and across, to a factor of {factor:g} ({where})",
        _SOURCE,
        "good correspondence",
        "; ".join(", ".join(f"{ratio:.2f}" for ratio in pair) for pair in ratios) + " times as large",
        tuple(bool((np.abs(np.log(pair)) < np.log(factor)).all()) for pair in ratios),
    )


def _ellipse_holds(scaled: Sequence[Foresight], where: str, published: Published) -> PaperFinding:
    least, most = published.rules.inside
    return PaperFinding(
        f"ellipses for {100 * _INSIDE:.0f} % of the places, scaled by the errors before, hold {100 * least:g} to "
        f"{100 * most:g} % ({where})",
        "ours",
        "-",
        "; ".join(f"{100 * one.inside:.0f} %" for one in scaled),
        tuple(least <= one.inside <= most for one in scaled),
    )
