"""Plants with drawn parameters are recovered: twenty minutes of processor time, so only where asked for."""

import os

import pytest
from twin_parts import MOTORS, drawn_truth, fitted, in_terms_of, known_robot, record_of

SEEDS = (21, 22, 23, 24, 25, 26)
"""Not among those that anything was chosen on (11, 12, 13)."""

if "DIFFDRIVE_MPC_ALL" in os.environ:

    def test_parameters_are_inside_their_intervals(tmp_path):
        """Of 95 % intervals, at most as many miss as chance allows once in a thousand (8 of 48, binomial)."""
        file = tmp_path / "motors.yaml"
        file.write_text(MOTORS)
        missed = []
        for seed in SEEDS:
            truth = drawn_truth(seed)
            fit = fitted(record_of(known_robot(truth), seed, 60.0), file, 30.0)
            expected = in_terms_of(fit, truth)
            for one in fit.told:
                if one.name in expected and not one.low <= expected[one.name] <= one.high:
                    missed.append((seed, one.name, expected[one.name], one.low, one.high))
        assert len(missed) <= 8, missed

else:

    @pytest.mark.skip(reason="twenty minutes: DIFFDRIVE_MPC_ALL=1")
    def test_parameters_are_inside_their_intervals():
        pass
