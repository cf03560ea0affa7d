"""Trial of mapping changes proposed by findings; only changes that improve the prediction become advice.

For each proposal, the mapping is changed, the log is read again, an SM is fitted to the thinned training rows, and the
SM predicts the held-out rows. The same rows are used before and after the change. FIT is invariant to units and signs,
and a free dead time absorbs time shifts. Therefore the coherence of the streams, under gains and delays of a plausible
robot, is also scored. A proposal is accepted if FIT or coherence improves significantly, FIT decreases in no channel,
and coherence does not decrease on average. FIT and coherence do not depend on rate and direction of the clock, so poses
must confirm a change of the clock. A proposal that only states the reader's default is accepted if it removes an error
of the reader. The best proposal is applied, and the remaining proposals are then tried in addition to it, until no
proposal is accepted. A cut of the log is scored on the held-out rows of the remaining part; the model without the cut
is not fitted to these rows.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.identification.fit.pose_calibration import calibrate_lags
from diffdrive_mpc.models.identification.log_data import divide, most_informative, select_usable
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs import Finding, Log, Record, read_log
from diffdrive_mpc.models.logs.check_settings import check_settings
from diffdrive_mpc.models.logs.diagnosis.coherence import coherence
from diffdrive_mpc.models.logs.diagnosis.streams import streams_of
from diffdrive_mpc.models.logs.mapping import LogMapping
from diffdrive_mpc.models.logs.mapping_changes import apply_changes, base_mapping, format_mapping
from diffdrive_mpc.models.logs.record import MappingChange, UnsoundLogError
from diffdrive_mpc.models.output_error.experiment import YawSource, twist_experiments
from diffdrive_mpc.models.output_error.validation import fit_percents, simulate_records
from diffdrive_mpc.models.structures.sm import identify_sm

Changes = tuple[MappingChange, ...]
Spans = list[tuple[float, float]]
FIXED_FILE, FIXED_AGAIN = "fixed.yaml", "fixed_again.yaml"


@dataclass(frozen=True)
class LogSelection:
    """Logs and their division; the attributes equal the arguments of `identify` with these names."""

    logs: tuple[Path, ...]
    validate: tuple[Path, ...]
    mapping: str | Path | LogMapping | None
    fit_share: float


@dataclass(frozen=True)
class Score:
    """Quality of the logs as read with a mapping.

    Attributes
    ----------
    fit
        FIT (2,) of v and omega on held-out rows [%].
    agreement
        Agreement of the streams as computed by `coherence` [%].
    errors
        Number of errors that the log reader finds before it compares the streams.
    """

    fit: FloatArray
    agreement: float
    errors: int

    def gain_over(self, reference: Score | None) -> float:
        """Compute the improvement over `reference` [percentage points]; 0 if it is not significant."""
        settings = identification_settings().advice
        if reference is None:
            return float(self.fit.mean()) if self.fit.min() > 0 else 0.0
        fit, agreement = self.fit - reference.fit, float(np.nan_to_num(self.agreement - reference.agreement))
        is_worse = min(float(fit.min()), agreement) < -settings.tolerance
        corrected_errors = reference.errors - self.errors
        is_better = max(float(fit.mean()), agreement) > settings.min_gain or corrected_errors > 0
        gain = max(float(fit.mean()), 0.0) + max(agreement, 0.0) + max(corrected_errors, 0)
        return gain if is_better and not is_worse else 0.0


@dataclass(frozen=True)
class Advice:
    """Mapping that improves the prediction of the logs.

    Attributes
    ----------
    selection
        Logs and their division.
    mapping
        Complete mapping with the changes.
    changes
        Changes relative to the mapping with which the logs were read.
    before, after
        Quality of the logs before and after the changes; `before` is None if the logs were unusable.
    """

    selection: LogSelection
    mapping: LogMapping
    changes: Changes
    before: Score | None
    after: Score

    @property
    def file(self) -> str:
        """File name of the mapping, which differs from the name of the original mapping file."""
        mapping = self.selection.mapping
        return FIXED_AGAIN if isinstance(mapping, str | Path) and Path(mapping).name == FIXED_FILE else FIXED_FILE

    def text(self) -> str:
        """Format the mapping as the text of a file."""
        return format_mapping(self.mapping)

    def write(self, folder: Path) -> None:
        """Write the mapping file to `folder`; raise OSError on failure."""
        (folder / self.file).write_text(self.text(), encoding="utf-8")

    def sentence(self, folder: Path = Path()) -> str:
        """Describe the improvement and the command that uses the mapping file in `folder`."""
        path = str(folder / self.file)
        changes = ", ".join(map(str, self.changes))
        fit, settings = f"{_percent(self.after)} in a quick fit", identification_settings().advice
        if self.before is None:
            improvement = f"the held-out FIT is {fit}; without this mapping no model can be fitted"
        elif float((self.after.fit - self.before.fit).mean()) > settings.min_gain:
            improvement = f"the held-out FIT becomes {fit} instead of {_percent(self.before)}"
        elif self.after.agreement - self.before.agreement > settings.min_gain:
            agreement = f"{self.after.agreement:.0f} % instead of {self.before.agreement:.0f} %"
            improvement = f"the agreement of the streams is {agreement}, and the held-out FIT remains {fit}"
        else:
            improvement = f"the log is read without an error, and the held-out FIT remains {fit}"
        validation_options = [word for log in self.selection.validate for word in ("--validate", str(log))]
        command = ["diffdrive-mpc", "identify", *map(str, self.selection.logs), *validation_options, "--mapping", path]
        return f"With the mapping {path} ({changes}) {improvement}: {shlex.join(command)}"


def _percent(score: Score) -> str:
    return "/".join(f"{fit:.0f}" for fit in score.fit) + " %"


class AdvisedError(UnsoundLogError):
    """Error for a log whose mapping leads to a wrong model.

    Attributes
    ----------
    advice
        Mapping that corrects the log; None if no mapping corrects it.
    """

    def __init__(self, findings: Sequence[Finding], advice: Advice | None) -> None:
        super().__init__(drop_rejected(findings, advice))
        self.advice = advice


def drop_rejected(findings: Iterable[Finding], advice: Advice | None) -> tuple[Finding, ...]:
    """Remove the proposed changes that are not part of the advice from the findings, and name them as unconfirmed."""
    advised = set() if advice is None else set(advice.changes)
    advised_keys = {(change.stream, change.key) for change in advised}

    def without_changes(finding: Finding) -> Finding:
        proposal = ", ".join(map(str, finding.changes))
        message = f"{finding.message}; not confirmed by a quick fit: {proposal}"
        return replace(finding, message=message, changes=())

    return tuple(
        finding
        if all((change.stream, change.key) in advised_keys for change in finding.changes)
        else without_changes(finding)
        for finding in findings
    )


def advise(
    selection: LogSelection, findings: Sequence[Finding], on_progress: Callable[[str], None] | None = None
) -> Advice | None:
    """Find the best mapping among the proposals of the findings; None if no proposal improves the prediction."""
    proposals = _proposals(findings)
    mapping = _read_mapping(selection) if proposals else None
    if mapping is None:
        return None
    if on_progress:
        on_progress("trial of proposed mappings")
    start = best = _Trial.make(selection, mapping, ())
    rows = start.rows() if start else None
    before = score = start.score(rows) if start and rows else None
    for _ in range(identification_settings().advice.max_changes):
        applied = best.changes if best else ()
        trials = [
            (proposal, *_score_trial(trial, best, score, rows))
            for proposal in proposals
            if (trial := _Trial.make(selection, mapping, (*applied, *proposal))) is not None and trial.has_valid_clock()
        ]
        accepted = max(trials, key=lambda row: row[1], default=None)
        if accepted is None or accepted[1] <= 0:
            break
        proposal, _, best, score, rows = accepted
        proposals.remove(proposal)
        if start is None:
            proposals = _proposals(best.findings())
    if best is None or not best.changes or score is None or rows is None:
        return None
    if _has_no_remedy(findings) and _has_no_remedy(best.findings()):
        return None
    if start and _is_cut(best.changes):
        before = start.score(start.rows().with_held_out(rows))
    return Advice(selection, best.mapping, best.changes, before, score)


def _read_mapping(selection: LogSelection) -> LogMapping | None:
    try:
        return base_mapping(selection.logs[0], selection.mapping)
    except ConfigError:
        return None


def _score_trial(
    trial: _Trial, best: _Trial | None, score: Score | None, rows: _Division | None
) -> tuple[float, _Trial, Score | None, _Division | None]:
    """Score a trial against the best trial so far; return improvement, trial, score and rows."""
    if rows is None or best is None:
        trial_rows, reference = trial.rows(), None
    elif _is_cut(trial.changes) and not _is_cut(best.changes):
        trial_rows = trial.rows()
        reference = best.score(rows.with_held_out(trial_rows))
    else:
        trial_rows, reference = rows, score
    trial_score = trial.score(trial_rows)
    return (0.0 if trial_score is None else trial_score.gain_over(reference)), trial, trial_score, trial_rows


def _is_cut(changes: Changes) -> bool:
    return any(change.key == "times" for change in changes)


def _has_no_remedy(findings: Iterable[Finding]) -> bool:
    """Return True if no change of the mapping corrects an error, for instance of a dead encoder."""
    return any(finding.severity == "error" and not finding.changes for finding in findings)


def _proposals(findings: Iterable[Finding]) -> list[Changes]:
    """List the distinct proposals of the findings; only the first of several values for one key is included."""
    distinct: dict[tuple[tuple[str, str], ...], Changes] = {}
    for finding in findings:
        if finding.changes:
            distinct.setdefault(tuple((change.stream, change.key) for change in finding.changes), finding.changes)
    return list(distinct.values())


@dataclass(frozen=True, eq=False)
class _Trial:
    """Logs as read with one mapping.

    Attributes
    ----------
    selection, mapping, changes
        Logs and their division, mapping, and its changes, as in `Advice`.
    logs
        All logs, starting with the training logs.
    """

    selection: LogSelection
    mapping: LogMapping
    changes: Changes
    logs: tuple[Log, ...]

    @classmethod
    def make(cls, selection: LogSelection, mapping: LogMapping, changes: Changes) -> _Trial | None:
        """Read the logs with the changed mapping; return None if a change cannot be applied or a log cannot be read."""
        logs: list[Log] = []
        try:
            mapping = apply_changes(mapping, changes)
            for path in (*selection.logs, *selection.validate):
                dt = logs[0].records[0].dt if logs else None
                logs.append(read_log(path, mapping, dt, diagnosed=False))
        except (ConfigError, ValueError):
            return None
        return cls(selection, mapping, changes, tuple(logs))

    def findings(self) -> list[Finding]:
        """List the findings of the training logs read with this mapping."""
        return [finding for path in self.selection.logs for finding in read_log(path, self.mapping).findings]

    def has_valid_clock(self) -> bool:
        """Return False if the mapping changes the clock and no poses confirm its rate and direction."""
        if not any(change.key == "sample_time" for change in self.changes):
            return True
        records_with_pose = [record for log in self.logs for record in log.records if record.pose is not None]
        try:
            scale = calibrate_lags(records_with_pose).value("wheels.scale")
        except ValueError:
            return False
        return abs(scale - 1.0) <= identification_settings().advice.clock_tolerance

    def rows(self) -> _Division:
        """Select thinned training rows and thinned held-out rows."""
        max_rows = identification_settings().advice.rows
        count = len(self.selection.logs)
        train: list[Spans] = []
        held_out: list[Spans] = []
        for number, log in enumerate(self.logs):
            pieces: tuple[Sequence[Record], Sequence[Record]] = ((), log.records)
            if number < count:
                has_validation = bool(self.selection.validate)
                pieces = (log.records, ()) if has_validation else divide(log.records, self.selection.fit_share)
            for spans, part in zip((train, held_out), pieces, strict=True):
                thinned = most_informative(part, max_rows // count) if part else ()
                spans.append([(record.start, record.end) for record in thinned])
        return _Division(tuple(train), tuple(held_out))

    def score(self, rows: _Division) -> Score | None:
        """Fit a model to the training rows and score it on the held-out rows; None if the fit is impossible."""
        try:
            train, held_out = (self._select_usable(spans) for spans in (rows.train, rows.held_out))
            yaw: YawSource = "gyro" if train[0].yaw_rate is not None else "encoders"
            system = identify_sm(train, yaw=yaw, limits=False).system
            fit = fit_percents(simulate_records(system, held_out, yaw), twist_experiments(held_out, yaw))
        except ValueError:  # includes ConfigError
            return None
        settings = check_settings()
        agreement = [coherence(streams_of(log.records, settings), settings) for log in self.logs]
        return Score(fit, float(np.mean(agreement)), sum(len(log.errors) for log in self.logs))

    def _select_usable(self, spans: tuple[Spans, ...]) -> tuple[Record, ...]:
        """Select the parts of the logs within the spans that have all signals."""
        records = [
            part
            for log, log_spans in zip(self.logs, spans, strict=True)
            for record in log.records
            for part in _cut(record, log_spans)
        ]
        gyro = ["yaw_rate"] if any(record.yaw_rate is not None for log in self.logs for record in log.records) else []
        return select_usable(records, ("twist", *gyro), "for the trial of a mapping", [])


@dataclass(frozen=True)
class _Division:
    """Division of the rows: time spans [s] of the training rows and of the held-out rows of each log."""

    train: tuple[Spans, ...]
    held_out: tuple[Spans, ...]

    def with_held_out(self, division: _Division) -> _Division:
        """Return the held-out rows of `division`, and the training rows of this division minus these rows."""
        train = tuple(_subtract(*spans) for spans in zip(self.train, division.held_out, strict=True))
        return _Division(train, division.held_out)


def _subtract(spans: Spans, removed: Spans) -> Spans:
    """Subtract the spans `removed` from `spans` [s]."""
    for removed_start, removed_end in removed:
        pieces = [((start, min(end, removed_start)), (max(start, removed_end), end)) for start, end in spans]
        spans = [piece for pair in pieces for piece in pair if piece[0] < piece[1]]
    return spans


def _cut(record: Record, spans: Spans) -> list[Record]:
    """Extract the parts of a record within `spans` [s]; rows do not depend on small differences of the start time."""
    pieces = []
    for span in spans:
        first, last = (round((time - record.start) / record.dt) for time in span)
        first, last = max(first, 0), min(last, len(record.command) - 1)
        if last > first:
            pieces.append(record.part(first, last + 1))
    return pieces
