"""The thirty-line baseline of `oracle.second_order` on records, and the rows on which models are compared with it."""

import numpy as np

from diffdrive_mpc.models.identification.log_data import divide, usable
from diffdrive_mpc.models.output_error.experiment import joined, twist_experiments
from diffdrive_mpc.models.output_error.validation import pooled_fit_percent
from oracle.second_order import fit_second_order, response

CUTS = [(place, share) for place in ("first", "last") for share in (0.5, 0.7)]
_NEEDED = ("twist", "yaw_rate", "wheels")


def cut_records(records, place, share):
    """Records to identify from, the first or last share of the rows, and those held out."""
    parts = divide(records, share if place == "first" else 1 - share)
    train, held_out = parts if place == "first" else parts[::-1]
    return usable(train, _NEEDED, "", []), usable(held_out, _NEEDED, "", [])


def baseline_fit(train, held_out, clip=False):
    """(2,) FIT [%] of the baseline, identified from `train`, on the records held out."""
    fits = []
    for row in (0, 1):
        one, other = ([s.channel(row, row) for s in joined(twist_experiments(part))] for part in (train, held_out))
        u, y, c = zip(*((s.inputs[:, 0], s.outputs[:, 0], s.counts[:, 0]) for s in one), strict=True)
        baseline = fit_second_order(u, y, c, one[0].dt, clip)
        firsts = [s.outputs[np.argmax(s.counts), 0] for s in other]
        runs = [response(baseline, s.inputs[:, 0], f, s.dt) for s, f in zip(other, firsts, strict=True)]
        keep = [s.counts[:, 0] for s in other]
        measured = [s.outputs[k, 0] for s, k in zip(other, keep, strict=True)]
        fits.append(pooled_fit_percent(measured, [r[k] for r, k in zip(runs, keep, strict=True)]))
    return np.array(fits)
