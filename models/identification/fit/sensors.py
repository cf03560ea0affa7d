"""Detection of reversed, scaled and delayed sensors by comparison of the sensors in a log."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import filterfalse
from pathlib import Path

import numpy as np

from diffdrive_mpc.models.identification.fit.pose_calibration import calibrate_delay, calibrate_gyro, calibrate_lags
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.logs.check_settings import check_settings
from diffdrive_mpc.models.logs.mapping import LogMapping, load_mapping
from diffdrive_mpc.models.logs.record import Finding, Record
from diffdrive_mpc.models.logs.record_checks import REMEDY

_DISTANCES = ("scaled sensor", "scaled poses", "slipping wheels")
"""Kinds of findings from ratios of distances or rotations, which a dead or reversed sensor changes, too."""


@dataclass(frozen=True)
class SensorCorrections:
    """Errors of sensors, with the keys of the group `sensors` of a controller's configuration.

    Attributes
    ----------
    stated
        Corrections stated by the log's mapping, by input ("wheels", "yaw_rate", "pose"): sign [-], delay [s].
    inferred
        Additional errors inferred from the readings, by input: scale [-], delay [s].
    findings
        Inferred errors as findings, with 95 % intervals.
    """

    stated: Mapping[str, Mapping[str, float]]
    inferred: Mapping[str, Mapping[str, float]]
    findings: tuple[Finding, ...] = ()

    @property
    def settings(self) -> dict[str, dict[str, float]]:
        """Content of the group `sensors` of the configuration, by input."""
        settings: dict[str, dict[str, float]] = {}
        for name in ("wheels", "yaw_rate", "pose"):
            stated, inferred = self.stated.get(name, {}), self.inferred.get(name, {})
            delay = round(stated.get("delay", 0.0) + inferred.get("delay", 0.0), 3)
            # A reading cannot precede the motion; a negative delay is therefore an error of the log's stamps.
            values = {**stated, **inferred, "delay": delay}
            settings[name] = {key: value for key, value in values.items() if key != "delay" or value > 0.0}
        return {name: values for name, values in settings.items() if values}

    def merged(self, findings: Sequence[Finding]) -> list[Finding]:
        """Return the findings of the log without time shifts that the inferred delays replace, and the inferred errors.

        A comparison of speeds also takes the lag of a filter for a shift, so its delays are less accurate. Inferred
        scales are left out if the log has errors.
        """
        delayed = {"gyro" if name == "yaw_rate" else name for name, v in self.inferred.items() if "delay" in v}

        def is_replaced(finding: Finding) -> bool:
            return finding.kind == "time shift" and delayed.issuperset(c.stream for c in finding.changes)

        # An error, such as a dead encoder, also changes distances.
        has_error = any(finding.severity == "error" for finding in findings)
        inferred = [finding for finding in self.findings if not (has_error and finding.kind in _DISTANCES)]
        return [*filterfalse(is_replaced, findings), *inferred]

    def correct(self, records: Sequence[Record]) -> tuple[Record, ...]:
        """Correct the records for the inferred errors."""
        return tuple(self._correct_record(record) for record in records)

    def _correct_record(self, record: Record) -> Record:
        inferred = self.inferred
        for name, field in (("yaw_rate", "yaw_rate"), ("wheels", "twist")):
            if "scale" in inferred.get(name, {}) and getattr(record, field) is not None:
                record = replace(record, **{field: getattr(record, field) / inferred[name]["scale"]})
        for field in ("yaw_rate", "pose"):
            steps = round(inferred.get(field, {}).get("delay", 0.0) / record.dt)
            value, fresh = getattr(record, field), record.fresh(field)
            if steps > 0 and value is not None and fresh is not None and steps < len(value) - 1:
                trimmed = record.part(0, len(value) - steps)
                record = replace(trimmed, name=record.name, **{field: value[steps:], f"fresh_{field}": fresh[steps:]})
        return record


def stated_corrections(mapping: LogMapping | None) -> dict[str, dict[str, float]]:
    """Return the corrections in a mapping by input; the robot's node, which does not use the mapping, requires them."""
    if mapping is None:
        return {}
    columns, topics = mapping.columns, mapping.topics
    stated: dict[str, dict[str, float]] = {}

    def add_correction(name: str, key: str, value: float, default: float) -> None:
        if value != default:
            stated.setdefault(name, {})[key] = value

    if columns:
        if columns.gyro:
            add_correction("yaw_rate", "sign", columns.gyro.yaw_rate.sign, 1)
        if columns.pose:
            add_correction("pose", "heading", columns.pose.heading_offset, 0.0)
        if columns.encoders and columns.encoders.v and columns.encoders.omega:
            add_correction("wheels", "sign", columns.encoders.v.sign, 1)
            add_correction("wheels", "turn_sign", columns.encoders.omega.sign, 1)
    elif topics:
        add_correction("yaw_rate", "sign", topics.imu.sign if topics.imu else 1, 1)
        add_correction("wheels", "turn_sign", topics.odometry.sign if topics.odometry else 1, 1)
    for name, roles_of_input in (("wheels", "encoders odometry"), ("yaw_rate", "gyro imu"), ("pose", "pose")):
        for role in roles_of_input.split():
            role_mapping = getattr(columns or topics, role, None)
            add_correction(name, "delay", role_mapping.delay if role_mapping else 0.0, 0.0)
    return stated


def find_corrections(
    name: str, records: Sequence[Record], mapping: str | Path | LogMapping | None
) -> SensorCorrections:
    """Estimate scales of gyro and encoders, and delays of poses and gyro; without enough poses, infer nothing.

    Parameters
    ----------
    name
        Name of the log in findings.
    records
        Records of the log.
    mapping
        Mapping with which the log was read.
    """
    loaded_mapping = mapping if mapping is None or isinstance(mapping, LogMapping) else load_mapping(mapping)
    stated = stated_corrections(loaded_mapping)
    inferred: dict[str, dict[str, float]] = {}
    findings: list[Finding] = []
    limits = identification_settings().sensors
    certainty, plausible = limits.significance, check_settings()

    def report(kind: str, text: str) -> None:
        findings.append(Finding(kind, "warning", name, f"{text}; `identify` sets 'sensors' in config.yaml"))

    with_pose = [record for record in records if record.pose is not None]
    try:
        has_gyro = bool(with_pose) and all(record.yaw_rate is not None for record in with_pose)
        if has_gyro and (level := _clipping_level(with_pose, limits.min_scale)):
            text = f"the gyro is clipped at {level:.3g} rad/s: increase its range, or do not use it"
            findings.append(Finding("clipped sensor", "warning", name, text))
        elif has_gyro:
            estimate = calibrate_delay(with_pose)
            delay, deviation = estimate.value("pose.delay"), estimate.deviation("pose.delay")
            readings, key = ("poses", "pose") if delay > 0 else ("readings of the gyro", "yaw_rate")
            # A sensor with a negative delay in the mapping is corrected in the log only, see `settings`.
            minimum = max(limits.min_delay, -stated.get(key, {}).get("delay", 0.0))
            if abs(delay) <= max(minimum, plausible.significance * deviation):
                delay = 0.0
            elif 1.96 * deviation > limits.max_delay_interval:
                text = f"the delay of the poses is not determined ({delay:.2f} +- {1.96 * deviation:.2f} s); {REMEDY}"
                findings.append(Finding("late sensor", "note", name, text))
                delay = 0.0
            else:
                inferred[key] = {"delay": round(abs(delay), 3)}
                text = f"{readings} are {abs(delay):.3f} +- {1.96 * deviation:.3f} s older than their stamps"
                report("late sensor", text)
            gyro = calibrate_gyro(with_pose, delay).parameters
            scale, deviation = gyro.value("gyro_scale"), gyro.deviation("gyro_scale")
            # A scale beyond the plausible gains is a wrong unit or a dead sensor, which the checks of the log report.
            is_plausible = plausible.gain_of_omega[0] < scale < plausible.gain_of_omega[1]
            is_known = 1.96 * deviation < plausible.known_gain * scale
            if is_plausible and is_known and abs(scale - 1.0) > max(limits.min_scale, limits.significance * deviation):
                inferred["yaw_rate"] = {"scale": round(scale, 4), **inferred.get("yaw_rate", {})}
                text = f"rotation of the gyro is {scale:.4f} +- {1.96 * deviation:.4f} times that of the poses"
                report("scaled sensor", text)
        if with_pose and all(record.twist is not None for record in with_pose):
            lags = calibrate_lags(SensorCorrections({}, inferred).correct(with_pose))
            scale, deviation = lags.value("wheels.scale"), lags.deviation("wheels.scale")
            size, is_significant = abs(math.log(scale)), abs(scale - 1.0) > certainty * deviation
            if size > limits.min_wheel_scale and is_significant and _commands_agree_with_poses(with_pose, scale):
                inferred["wheels"] = {"scale": round(scale, 4)}
                text = f"encoder distance is {scale:.3f} +- {1.96 * deviation:.3f} times that of poses and commands"
                report("scaled sensor", text)
            elif limits.min_scale < size < math.log(plausible.gain_of_v[1]) and is_significant:
                findings.append(_pose_scale_finding(name, scale, 1.96 * deviation, limits.min_slip))
    except ValueError:  # too few windows for an estimate
        pass
    return SensorCorrections(stated, inferred, tuple(findings))


def _pose_scale_finding(name: str, scale: float, interval: float, min_slip: float) -> Finding:
    """Return the finding for encoders and commands whose distance is `scale` times the distance of the poses."""
    text = f"distance of encoders and commands is {scale:.3f} +- {interval:.3f} times that of the poses: "
    if scale > min_slip:
        text += "the wheels slip or lose contact; drive slower, or on a surface with more grip"
        return Finding("slipping wheels", "warning", name, text)
    slip = "the wheels slip, or " if scale > 1.0 else ""
    text += f"{slip}the scale of the map or the wheel radius is wrong; measure a straight drive of 5 m with a tape"
    return Finding("scaled poses", "warning", name, text)


def _clipping_level(records: Sequence[Record], share: float) -> float:
    """Return the maximum gyro reading [rad/s] if more than `share` [-] of the readings equal it; otherwise 0."""
    readings = np.abs(np.concatenate([np.asarray(record.yaw_rate)[record.fresh("yaw_rate")] for record in records]))
    return float(readings.max()) if np.mean(readings == readings.max()) > share else 0.0


def _commands_agree_with_poses(records: Sequence[Record], scale: float) -> bool:
    """Return True if commands agree better with poses than with encoders, as for encoders with a wrong scale."""
    command, wheels = (
        np.concatenate([np.abs(np.asarray(getattr(record, field))[:, 0]) for record in records])
        for field in ("command", "twist")
    )
    is_known = np.isfinite(wheels)
    ratio = math.log(float(wheels[is_known].sum()) / max(float(command[is_known].sum()), 1e-9))
    return abs(ratio - math.log(scale)) < abs(ratio)
