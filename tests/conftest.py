"""One hypothesis profile for all tests: the same examples on every run, no deadline. ROS types that have no wheel."""

import os
import sys

import pytest
from hypothesis import settings

settings.register_profile("reproducible", deadline=None, derandomize=True, print_blob=False)
settings.load_profile("reproducible")


@pytest.fixture(scope="session")
def ros_types():
    """Lets this process and its children import nav2_msgs, tf2_msgs and bond: import them inside of tests.

    Returns the folder. Without it, tests run as on a machine that has no such packages.
    """
    from diffdrive_mpc.bench.ros_types.build import built_types, search_path

    folder = built_types()
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    os.environ["PYTHONPATH"] = search_path(folder, os.environ.get("PYTHONPATH", ""))
    return folder
