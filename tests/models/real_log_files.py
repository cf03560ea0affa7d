"""Logs of real robots, in the folder that DIFFDRIVE_MPC_DATA names. Tests of them have the mark `real_logs`."""

import os
from pathlib import Path

FOLDERS = {
    "husky_tile": "norlab_husky_tile",
    "warthog_asphalt": "norlab_warthog_terrains",
    "warthog_gravel": "norlab_warthog_terrains",
}
"""Folder of each log by its name, which is also the name of its mapping."""


def log_path(name):
    """Return the path of a log; raise KeyError without DIFFDRIVE_MPC_DATA."""
    return Path(os.environ["DIFFDRIVE_MPC_DATA"]) / FOLDERS[name] / f"{name}.csv"
