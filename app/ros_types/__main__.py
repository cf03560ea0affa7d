"""`python -m diffdrive_mpc.app.ros_types`: make the types, and print the line that lets a shell use them."""

from __future__ import annotations

import os
import shlex
import sys

from diffdrive_mpc.app.ros_types.build import PACKAGES, TypesError, built_types, search_path


def main() -> int:
    """Make the types and print a line for `eval "$(...)"`; what goes wrong is one line on the error stream."""
    try:
        folder = built_types()
    except (TypesError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stderr.write(f"{', '.join(PACKAGES)}: {folder}\n")
    sys.stdout.write(f"export PYTHONPATH={shlex.quote(search_path(folder, os.environ.get('PYTHONPATH', '')))}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
