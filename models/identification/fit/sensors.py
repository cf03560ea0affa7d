"""Detection of reversed, scaled or delayed sensors by comparison of the sensors of a log."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from diffdrive_mpc.models.identification.fit.pose_calibration import calibrate_delay, calibrate_gyro, calibrate_lags
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.logs.mapping import LogMapping, load_mapping
from diffdrive_mpc.models.logs.record import Finding, Record


@dataclass(frozen=True)
class SensorCorrections:
    """Errors of sensors in the terms of the group `sensors` of a controller's configuration.

    Attributes
    ----------
    stated
        Corrections stated by the log's mapping, by input ("wheels", "yaw_rate", "pose"): sign [-], delay [s].
    inferred
        Additional errors found in the readings, by input: scale [-], delay [s].
    findings
        Inferred errors as findings, with 95 % intervals.
    """

    stated: Mapping[str, Mapping[str, float]]
    inferred: Mapping[str, Mapping[str, float]]
    findings: tuple[Finding, ...] = ()

    @property
    def settings(self) -> dict[str, dict[str, float]]:
        """Content of the group `sensors` of the configuration, by input."""
        merged: dict[str, dict[str, float]] = {}
        for name in ("wheels", "yaw_rate", "pose"):
            stated, inferred = self.stated.get(name, {}), self.inferred.get(name, {})
            delay = round(stated.get("delay", 0.0) + inferred.get("delay", 0.0), 3)
            # A reading cannot precede its cause: a negative delay is a property of the log.
            values = {**stated, **inferred, "delay": delay}
            merged[name] = {key: value for key, value in values.items() if key != "delay" or value > 0.0}
        return {name: values for name, values in merged.items() if values}

    def correct(self, records: Sequence[Record]) -> tuple[Record, ...]:
        """Return the records, corrected for the inferred errors."""
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
                rest = record.part(0, len(value) - steps)
                record = replace(rest, name=record.name, **{field: value[steps:], f"fresh_{field}": fresh[steps:]})
        return record


def stated_corrections(mapping: LogMapping | None) -> dict[str, dict[str, float]]:
    """Return the corrections of a mapping by input, for the robot's node, which reads sensors without the mapping."""
    if mapping is None:
        return {}
    columns, topics = mapping.columns, mapping.topics
    stated: dict[str, dict[str, float]] = {}

    def state(name: str, key: str, value: float, default: float) -> None:
        if value != default:
            stated.setdefault(name, {})[key] = value

    if columns:
        if columns.gyro:
            state("yaw_rate", "sign", columns.gyro.yaw_rate.sign, 1)
        if columns.pose:
            state("pose", "heading", columns.pose.heading_offset, 0.0)
        if columns.encoders and columns.encoders.v and columns.encoders.omega:
            state("wheels", "sign", columns.encoders.v.sign, 1)
            state("wheels", "turn_sign", columns.encoders.omega.sign, 1)
    elif topics:
        state("yaw_rate", "sign", topics.imu.sign if topics.imu else 1, 1)
        state("wheels", "turn_sign", topics.odometry.sign if topics.odometry else 1, 1)
    for name, roles in (("wheels", "encoders odometry"), ("yaw_rate", "gyro imu"), ("pose", "pose")):
        for role in roles.split():
            part = getattr(columns or topics, role, None)
            state(name, "delay", part.delay if part else 0.0, 0.0)
    return stated


def find_corrections(
    name: str, records: Sequence[Record], mapping: str | Path | LogMapping | None
) -> SensorCorrections:
    """Estimate scales of gyro and encoders, and delays of poses and gyro; none if the log has too few poses.

    Parameters
    ----------
    name
        Name of the log in findings.
    records
        Records of the log.
    mapping
        Mapping with which the log was read.
    """
    inferred: dict[str, dict[str, float]] = {}
    findings: list[Finding] = []
    rule = identification_settings().sensors

    def report(kind: str, words: str) -> None:
        findings.append(Finding(kind, "warning", name, f"{words}; `identify` states it under 'sensors' in config.yaml"))

    with_pose = [record for record in records if record.pose is not None]
    try:
        has_gyro = bool(with_pose) and all(record.yaw_rate is not None for record in with_pose)
        if has_gyro and (level := _clipping_level(with_pose, rule.least_scale)):
            words = f"the gyro is clipped at {level:.3g} rad/s: increase its range, or do not use it"
            findings.append(Finding("clipped sensor", "warning", name, words))
        elif has_gyro:
            estimate = calibrate_delay(with_pose)
            delay, deviation = estimate.value("pose.delay"), estimate.deviation("pose.delay")
            if abs(delay) > max(rule.least_delay, rule.certain * deviation):
                subject, key = ("poses", "pose") if delay > 0 else ("readings of the gyro", "yaw_rate")
                inferred[key] = {"delay": round(abs(delay), 3)}
                report(
                    "late sensor", f"{subject} are {abs(delay):.3f} +- {1.96 * deviation:.3f} s later than their stamps"
                )
            gyro = calibrate_gyro(with_pose, delay).parameters
            scale, deviation = gyro.value("gyro_scale"), gyro.deviation("gyro_scale")
            if abs(scale - 1.0) > max(rule.least_scale, rule.certain * deviation):
                inferred["yaw_rate"] = {"scale": round(scale, 4), **inferred.get("yaw_rate", {})}
                report(
                    "scaled sensor", f"the gyro turns {scale:.4f} +- {1.96 * deviation:.4f} times as far as the poses"
                )
        if with_pose and all(record.twist is not None for record in with_pose):
            lags = calibrate_lags(SensorCorrections({}, inferred).correct(with_pose))
            scale, deviation = lags.value("wheels.scale"), lags.deviation("wheels.scale")
            is_scaled = abs(math.log(scale)) > rule.least_wheel_scale and abs(scale - 1.0) > rule.certain * deviation
            if is_scaled and _commands_agree_with_poses(with_pose, scale):
                inferred["wheels"] = {"scale": round(scale, 4)}
                words = f"the encoders go {scale:.3f} +- {1.96 * deviation:.3f} times as far as poses and commands"
                report("scaled sensor", words)
            elif abs(math.log(scale)) > rule.least_scale and abs(scale - 1.0) > rule.certain * deviation:
                findings.append(_unlike_poses(name, scale, 1.96 * deviation, rule.least_slip))
    except ValueError:  # too few windows for an estimate
        pass
    loaded = mapping if mapping is None or isinstance(mapping, LogMapping) else load_mapping(mapping)
    return SensorCorrections(stated_corrections(loaded), inferred, tuple(findings))


def _unlike_poses(name: str, scale: float, interval: float, least_slip: float) -> Finding:
    """Return the finding for wheels that go `scale` times as far as the poses, as their commands do."""
    words = f"encoders and commands go {scale:.3f} +- {interval:.3f} times as far as the poses: "
    if scale > least_slip:
        words += "the wheels slip or leave the ground; drive slower, or on a floor with more grip"
        return Finding("slipping wheels", "warning", name, words)
    slip = "the wheels slip, or " if scale > 1.0 else ""
    words += f"{slip}the scale of the map or the wheel radius is wrong; measure a straight of 5 m with a tape"
    return Finding("scaled poses", "warning", name, words)


def _clipping_level(records: Sequence[Record], share: float) -> float:
    """Return the maximum gyro reading [rad/s] if more than `share` of the readings have it; otherwise 0."""
    readings = np.abs(np.concatenate([np.asarray(record.yaw_rate)[record.fresh("yaw_rate")] for record in records]))
    return float(readings.max()) if np.mean(readings == readings.max()) > share else 0.0


def _commands_agree_with_poses(records: Sequence[Record], scale: float) -> bool:
    """Return whether commands agree better with poses than with encoders; encoders of slipping wheels agree better."""
    command, wheels = (
        np.concatenate([np.abs(np.asarray(getattr(record, field))[:, 0]) for record in records])
        for field in ("command", "twist")
    )
    known = np.isfinite(wheels)
    ratio = math.log(float(wheels[known].sum()) / max(float(command[known].sum()), 1e-9))
    return abs(ratio - math.log(scale)) < abs(ratio)
