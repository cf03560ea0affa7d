"""The proof on real logs: rows are divided as the protocol says, and bad input ends in one line."""

import numpy as np
import pytest

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs import Record
from studies.real_logs.protocol import divide, load_protocol


def record(count, every=1):
    """Samples of which every so many-th has a reading of the gyro."""
    fresh = np.zeros(count, dtype=bool)
    fresh[::every] = True
    return Record(
        "a stretch", 0.0, 0.05, np.zeros((count, 2)), np.zeros((count, 2)), np.zeros(count), fresh_yaw_rate=fresh
    )


@pytest.mark.parametrize("share", [0.2, 0.5, 0.6, 0.9])
def test_rows_are_divided_by_readings_in_the_order_of_time(share):
    records = [record(400), record(800, every=2), record(600)]
    rows = 400 + 400 + 600
    first, last = divide(records, share)
    assert sum(int(r.fresh_yaw_rate.sum()) for r in first) == pytest.approx(share * rows, abs=1)
    assert sum(len(r.command) for r in (*first, *last)) == 1800


def test_a_rest_too_short_to_simulate_is_left_out():
    first, last = divide([record(100), record(100)], 0.52)
    assert [len(r.command) for r in first] == [100]
    assert [len(r.command) for r in last] == [96]


def test_every_log_states_a_figure_for_each_horizon_or_for_none():
    protocol = load_protocol()
    for log in protocol.logs.values():
        assert len(log.stated.fit_percent) == 3
        assert len(log.stated.position) == len(log.stated.heading) in (0, len(protocol.horizons))


def test_an_unknown_log_is_refused_in_one_line():
    with pytest.raises(ConfigError, match="unknown log 'husk'.*husky"):
        load_protocol().log("husk")
