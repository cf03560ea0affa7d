"""A configuration beside what the maker of the robot states: bounded by it, completed where the log does not tell."""

from __future__ import annotations

from dataclasses import replace

from diffdrive_mpc.models.identification.deliver.configuration import IdentifiedConfiguration, Setting
from diffdrive_mpc.models.stated_robot import MakersRobot, StatedKey


def within_stated(configuration: IdentifiedConfiguration, robot: MakersRobot) -> IdentifiedConfiguration:
    """The same with limits no larger than stated, and the stated value where the log tells none.

    What the log tells is kept, as long as the maker's limits allow it: they clip the command in the base, so that the
    controller's model would be wrong beyond them.
    """
    keys = robot.configuration()
    shares: dict[str, float] = {
        channel: min(1.0, float(keys[f"limits.{channel}"].value) / float(setting.value))
        for channel in ("v", "omega")
        for setting in configuration.limits
        if setting.name == channel
    }
    bounded = [_bounded(setting, keys, shares, robot.name) for setting in configuration.limits]
    groups = {"limits": bounded, "wheels": list(configuration.wheels), "free_space": list(configuration.free_space)}
    for key, stated in keys.items():
        group, _, name = key.partition(".")
        if name not in {setting.name for setting in groups[group]}:
            value = f"'{stated.value}'" if isinstance(stated.value, str) else stated.value
            groups[group].append(Setting(name, value, f"{stated.reason}, stated by the maker of {robot.name}"))
    limits, wheels, free_space = (tuple(settings) for settings in groups.values())
    return replace(configuration, limits=limits, wheels=wheels, free_space=free_space)


def _bounded(setting: Setting, keys: dict[str, StatedKey], shares: dict[str, float], robot: str) -> Setting:
    """A limit of the log, no larger than the one that is stated; what is predicted goes with it."""
    unit, value = setting.reason.partition(", ")[0], float(setting.value)
    stated, share = keys.get(f"limits.{setting.name}"), shares.get(setting.name.removeprefix("predicted_"), 1.0)
    if stated is not None and float(stated.value) < value:
        return Setting(setting.name, float(stated.value), f"{unit}, stated by the maker of {robot}; the log: {value:g}")
    if share < 1.0 and stated is None:
        return Setting(setting.name, float(f"{share * value:.4g}"), f"{unit}, for the limit that the maker states")
    return setting
