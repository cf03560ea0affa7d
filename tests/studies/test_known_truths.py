"""Known truths come back within what the identification says about itself."""

import numpy as np
import pytest

from studies.shipped_models.known_truths import RecoveredTruth, coverage_table, recover, recover_all


@pytest.mark.long
def test_truths_lie_within_four_standard_deviations():
    done = []
    recoveries = recover_all(6, lambda count, total: done.append((count, total)))
    assert done == [(i, 6) for i in range(1, 7)]
    scores = np.concatenate([recovery.standardised for recovery in recoveries])
    assert np.abs(scores).max() < 4.0
    # Deviations that were far too large would pass the line above.
    assert 0.6 < np.sqrt(np.mean(scores**2)) < 1.5


def test_a_seed_fixes_a_recovery():
    first, second = recover(3), recover(3)
    assert first.estimate.tolist() == second.estimate.tolist()
    assert first.truth.tolist() == second.truth.tolist()
    assert first.truth.tolist() != recover(4).truth.tolist()


def test_the_table_counts_what_is_inside():
    truth = np.zeros(4)
    errors = np.array([0.5, 1.9, 2.1, -3.0])
    names = ("v.gain", "omega.gain", "v.pole_1", "v.pole_2")
    rows = {row[0]: row for row in coverage_table([RecoveredTruth(0, names, truth, errors, np.ones(4), 0.1)]).rows}
    assert rows["gain"][1:3] == ("2", "100.0")
    assert rows["pole"][1:3] == ("2", "0.0")
    assert rows["all"][2] == "50.0"
    assert float(rows["all"][4]) == pytest.approx(3.0)
