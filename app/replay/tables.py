"""The tables of a replay."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from diffdrive_mpc.app.replay.open_loop import Replayed
from diffdrive_mpc.app.replay.recording import Recording
from diffdrive_mpc.app.replay.statistics import Difference, SensorRow, shares
from diffdrive_mpc.app.replay.verdicts import Diagnosis
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.logs.record import BoolArray

_SAID = 12
_WORDS = 160


def verdict_table(verdicts: Sequence[Diagnosis]) -> Table:
    """What the log tells, and what can be done."""
    rows = tuple((verdict.what, verdict.remedy) for verdict in verdicts)
    return Table("Worth a look", ("what the log shows", "what to do"), rows, 2)


def command_table(pairs: Mapping[tuple[str, str], Difference]) -> Table:
    """A row for v and one for omega of each pair that is compared."""
    rows = []
    for (one, other), pair in pairs.items():
        for i, name in enumerate(("v [m/s]", "omega [rad/s]")):
            cells = (f"{pair.rms[i]:.3g}", f"{pair.largest[i]:.3g}", number(pair.largest_at[i], 2))
            share = f"{pair.differing} of {pair.compared}"
            rows.append((f"{one} - {other}", name, *cells, share, number(pair.first, 2)))
    columns = ("commands", "of", "RMS", "largest", "at [s]", "ticks that differ", "first [s]")
    return Table("Commands", columns, tuple(rows), 2, note="Differing: by more than 1e-9 m/s or rad/s.")


def share_table(title: str, columns: Mapping[str, Sequence[str]], counted: BoolArray) -> Table:
    """Share of the ticks by word, a column for each who said them."""
    by_column = {who: shares(words, counted) for who, words in columns.items()}
    by_column = {who: of for who, of in by_column.items() if of}
    names = list(dict.fromkeys(word for of in by_column.values() for word in of))
    rows = tuple((word, *(f"{of.get(word, 0.0):.1f}" for of in by_column.values())) for word in names)
    return Table(title, ("", *(f"{who} [% of ticks]" for who in by_column)), rows)


def sensor_table(sensors: Sequence[SensorRow]) -> Table:
    """When readings came, and how they fit to what was predicted."""
    rows = []
    for row in sensors:
        times = [number(1e3 * one, 1) for one in (row.interval, row.age_p50, row.age_p99)]
        gap = f"{row.longest_gap:.3f} at {row.gap_at:.2f}" if np.isfinite(row.longest_gap) else "-"
        fits = ", ".join(number(mean, 2) for _, _, mean in row.innovations)
        rows.append((row.name, str(row.readings), *times, gap, fits))
    columns = (
        "sensor",
        "readings",
        "every [ms]",
        "age p50 [ms]",
        "age p99 [ms]",
        "longest pause [s]",
        "innovations [-]",
    )
    note = (
        "Age: from its stamp to the tick that got it. Innovations: usual squared difference from what was predicted "
        "over its variance (by medians), 1 where the estimator's assumptions hold; of wheels for v and for omega."
    )
    return Table("Sensors", columns, tuple(rows), note=note)


def time_table(replays: Mapping[str, Replayed], counted: BoolArray) -> Table:
    """How long steps took on this computer."""
    rows = []
    for who, replayed in replays.items():
        for name, times in (("step", replayed.step_time), ("solve", replayed.solve_time)):
            known = 1e3 * times[counted & np.isfinite(times)]
            cells = np.percentile(known, [50, 99, 100]) if len(known) else np.full(3, np.nan)
            rows.append((who, name, *(number(float(cell), 3) for cell in cells)))
    note = "Of the replay on this computer, among whatever else ran on it; not of the drive."
    return Table("Step times", ("", "of", "p50 [ms]", "p99 [ms]", "max [ms]"), tuple(rows), 2, note)


def message_table(recording: Recording, replayed: Replayed, counted: BoolArray) -> Table:
    """What the controller says, with how often and when first; the most frequent."""
    counts: Counter[str] = Counter()
    first: dict[str, float] = {}
    for tick, message, keep in zip(recording.ticks, replayed.messages, counted, strict=True):
        if message and keep:
            kind = _without_numbers(message)
            counts[kind] += 1
            first.setdefault(kind, tick.time)
    rows = tuple((kind[:_WORDS], str(count), number(first[kind], 2)) for kind, count in counts.most_common(_SAID))
    return Table("What the controller says", ("message", "ticks", "first at [s]"), rows, note="Numbers as #.")


def _without_numbers(message: str) -> str:
    """Messages that differ in their numbers alone are of one kind."""
    parts, inside = [], False
    for letter in message:
        number_like = letter.isdigit() or (inside and letter == ".")
        if not number_like:
            parts.append(letter)
        elif not inside:
            parts.append("#")
        inside = number_like
    return "".join(parts)
