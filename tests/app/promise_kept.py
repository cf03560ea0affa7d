"""Test the promise of an identification's verdict with random variations of an independent model.

The model is fitted to the held-out rows; its residuals on the rows of the fit are added as a disturbance.
`python tests/app/promise_kept.py husky --draws 300` prints the result. Its exit code is 1 if fewer than 95 % of the
variations keep the promise.
"""

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import count, islice
from pathlib import Path

import numpy as np

from diffdrive_mpc import ModelError, VelocityModel, identify
from diffdrive_mpc.app.identification.trial_drives import (
    HELD_OUT,
    StandIn,
    log_sensors,
    log_slip,
    trial_drives,
    trial_settings,
)
from diffdrive_mpc.app.identification.unexplained_motion import identified_robot
from diffdrive_mpc.app.identification.verdict import TrialVerdict, judge_by_drives
from diffdrive_mpc.models.identification import Identification
from diffdrive_mpc.models.identification.fit.fitting import fit
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.mpc import ControllerConfig
from studies.reproduce.real_logs import RealLog, load_protocol


@dataclass(frozen=True)
class KeptPromise:
    """Share of variations in which the promise held.

    Attributes
    ----------
    verdict
        Verdict with the promise.
    lateral
        (n,) largest lateral error of each variation on a curved path [m]; infinity if it did not arrive.
    """

    verdict: TrialVerdict
    lateral: tuple[float, ...]

    @property
    def held_count(self) -> int:
        """Number of variations in which the promise held."""
        promised = self.verdict.performance
        return 0 if promised is None else sum(error <= promised.lateral for error in self.lateral)

    def __str__(self) -> str:
        """Format the promise and its errors in one line."""
        low, high = np.median(self.lateral), np.quantile(self.lateral, 0.95, method="higher")
        return (
            f"{self.verdict.promise}: kept in {self.held_count} of {len(self.lateral)} variations; "
            f"largest lateral error, median {low:.3f} m, 95 % below {high:.3f} m"
        )


def keep_promise(
    log: RealLog, data: Path, draws: int, seed: int, on_run: Callable[[], None] = lambda: None
) -> KeptPromise:
    """Identify an SM, and drive its configuration on `draws` variations of a model of the held-out rows.

    Raises
    ------
    ValueError, OSError
        If the log cannot be used, or its verdict contains no promise.
    """
    verdict = judge_by_drives(identify(data / log.file, mapping=log.mapping))
    if verdict.performance is None or verdict.config is None:
        raise ValueError(f"{log.robot}: nothing is promised: {verdict.failure}")
    paths, lateral = trial_settings().curved, []
    for i, stand_in in enumerate(islice(_variations(verdict.identification, verdict.config, seed), draws)):
        (drive,) = trial_drives(
            verdict.identification, verdict.config, [stand_in], paths=[paths[i % len(paths)]], seed=seed + i
        )
        lateral.append(drive.metrics.lateral_max_m if drive.metrics.completed else np.inf)
        on_run()
    return KeptPromise(verdict, tuple(lateral))


def _variations(identification: Identification, config: ControllerConfig, seed: int) -> Iterator[StandIn]:
    """Yield models of the held-out rows with random parameters; parameters without a valid model are skipped."""
    data = identification.report.data
    held_out = replace(data, train=data.validation, validation=data.train)
    fitted = fit(held_out, STRUCTURES["ssm"], trial_settings().stand_in_order)
    exchanged = replace(identification, report=replace(identification.report, data=held_out, fitted=fitted))
    robot = identified_robot(exchanged, config)
    assert robot is not None
    slip, sensors = log_slip(identification, pose_point=True), log_sensors(identification, config)
    (estimate,) = fitted.identified.fits
    rng = np.random.default_rng(seed)
    for _ in count():
        system = estimate.layout.system(rng.multivariate_normal(estimate.parameters, estimate.sandwich.covariance))
        disturbance = robot.disturbance(config.sample_time, rng)
        try:
            model = VelocityModel("drawn", "ssm", system.A, system.B, system.C, system.dead_time)
        except ModelError:
            continue
        yield StandIn(HELD_OUT, model, fitted.identified.base_effects, disturbance, slip, sensors)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", help="husky, warthog-asphalt or warthog-gravel")
    parser.add_argument("--draws", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1000)
    words = parser.parse_args()
    data = Path(os.environ["DIFFDRIVE_MPC_DATA"])
    result = keep_promise(load_protocol().log(words.log), data, words.draws, words.seed)
    sys.stdout.write(f"{result}\n")
    sys.exit(result.held_count < 0.95 * words.draws)


if __name__ == "__main__":
    main()
