"""Fits of logs of real robots: cuts of the log cost little, and a plain fit predicts no better."""

import os
from dataclasses import replace
from functools import cache
from itertools import pairwise, product

import numpy as np
import pytest
from baseline_parts import baseline_fit
from real_log_files import FOLDERS, log_path

from diffdrive_mpc.models.identification.log_data import divide
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.output_error.validation import validate
from diffdrive_mpc.models.structures.sm import identify_sm

pytestmark = pytest.mark.real_logs
FEWEST = identification_settings().fewest_readings
CUTS = ("at the step", "60 rows before", "anywhere")
# Each log, and each way to cut, once; DIFFDRIVE_MPC_ALL=1 takes every log in every way.
EACH_ONCE = tuple(zip(FOLDERS, CUTS, strict=True))
CASES = tuple(product(FOLDERS, CUTS)) if "DIFFDRIVE_MPC_ALL" in os.environ else EACH_ONCE


def stretches(records, cut, past):
    """The records in pieces; what is too short for one is left out. Without a `past`, none follows the other."""
    pieces = []
    for record in records:
        count = len(record.command)
        steps = np.flatnonzero(np.any(np.diff(record.command, axis=0) != 0, axis=1)) + 1
        edges = {
            "at the step": steps,
            "60 rows before": steps - 60,
            "anywhere": np.random.default_rng(count).choice(count, count // 120, replace=False),
        }[cut]
        edges = np.unique([0, *edges[(edges > 0) & (edges < count)], count]).tolist()
        pieces += [record.part(a, b) for a, b in pairwise(edges) if past or b - a > 30]
    # As `identify` does.
    pieces = [p for p in pieces if min(p.fresh_twist.sum(), p.fresh_yaw_rate.sum()) >= FEWEST]
    return pieces if past else [replace(piece, start=3600.0 * i) for i, piece in enumerate(pieces)]


@cache
def halves(log):
    """Records to identify from and records held out, divided as `identify` does."""
    records = read_log(log_path(log), log).records
    if len(records) < 10:  # seven minutes in one piece says it as well as all of it
        records = (records[0].part(0, 8400),)
    return divide(records, 0.6)


@cache
def as_shipped(log):
    train, held_out = halves(log)
    return validate(identify_sm(train, limits=False).system, held_out).fit_percent


@pytest.mark.parametrize(("log", "cut"), CASES)
def test_a_cut_costs_less_than_three_points(log, cut):
    train, held_out = halves(log)
    found = validate(identify_sm(stretches(train, cut, past=True), limits=False).system, held_out).fit_percent
    assert (found > as_shipped(log) - 3.0).all(), found


@pytest.mark.parametrize("log", FOLDERS)
def test_a_plain_fit_is_no_better(log):
    assert (as_shipped(log) > baseline_fit(*halves(log)) - 0.5).all()


@pytest.mark.parametrize(("log", "cut"), CASES)
def test_nor_is_it_where_nothing_is_known_before_a_stretch(log, cut):
    train, held_out = halves(log)
    train = stretches(train, cut, past=False)
    found = validate(identify_sm(train, limits=False).system, held_out).fit_percent
    assert (found > baseline_fit(train, held_out) - 0.5).all(), found
