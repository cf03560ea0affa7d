"""Wild readings are left out and said; what a robot does is not taken for one."""

import numpy as np
import pytest
from identification_parts import DT, noisy_drive, two_channels

from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.validation import validate
from diffdrive_mpc.models.structures.sm import identify_sm

TRUE = two_channels((0.95, 10.0, 1.3), (0.7, 7.0, 0.7))


def spiked(drive, size):
    """One reading in a hundred of each sensor is off by up to `size`."""
    stream = np.random.default_rng(3)
    twist, yaw_rate = drive.twist.copy(), drive.yaw_rate.copy()
    for column in (twist[:, 0], yaw_rate):
        rows = stream.choice(len(column), len(column) // 100, replace=False)
        column[rows] += size * stream.uniform(0.5, 1.0, len(rows)) * stream.choice([-1, 1], len(rows))
    return Record("spiked", 0.0, DT, drive.command, twist=twist, yaw_rate=yaw_rate)


def as_read(drive, folder):
    """The drive as a log on disk gives it."""
    table = np.column_stack((drive.command, drive.twist, drive.yaw_rate))
    np.savetxt(folder / "log.csv", table, delimiter=",", header="v,w,ev,ew,gz", comments="")
    (folder / "map.yaml").write_text(
        f"columns:\n  sample_time: {DT}\n  command: {{v: v, omega: w}}\n"
        "  encoders: {v: ev, omega: ew}\n  gyro: {yaw_rate: gz}\n"
    )
    log = read_log(folder / "log.csv", folder / "map.yaml")
    return list(log.records), [finding for finding in log.findings if finding.kind == "spikes"]


@pytest.mark.long
@pytest.mark.parametrize("size", [5.0, 1000.0])
def test_one_wild_reading_in_a_hundred_costs_nothing(size, tmp_path):
    clean = noisy_drive(TRUE, 5)
    records, findings = as_read(spiked(clean, size), tmp_path)
    assert [finding.severity for finding in findings] == ["warning", "warning"]
    assert "(1 %)" in findings[1].words
    one, other = (identify_sm(part, limits=False) for part in ([clean], records))
    assert validate(other.system, [clean]).fit_percent == pytest.approx(
        validate(one.system, [clean]).fit_percent, abs=0.3
    )
    assert validate(other.system, records).fit_percent.min() > 85.0


@pytest.mark.parametrize("seed", range(5))
def test_a_sound_drive_has_none(seed, tmp_path):
    assert as_read(noisy_drive(TRUE, seed), tmp_path)[1] == []
