"""Compile free space into the wheel; pyproject.toml states the rest."""

import sys
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

sys.path.insert(0, str(Path(__file__).parent / "src"))


class BuildWithFreeSpace(build_py):
    """Copies the package and compiles free space into it; an editable installation compiles it at first use."""

    def run(self) -> None:
        """Build the package."""
        super().run()
        if not self.editable_mode:
            from diffdrive_mpc_extras.free_space.pieces import write_packaged  # noqa: PLC0415 - needs diffdrive-mpc

            write_packaged(Path(self.build_lib, "diffdrive_mpc_extras", "free_space"))


class PlatformWheel(bdist_wheel):
    """A wheel for one platform and any Python 3: free space is a plain library."""

    def get_tag(self) -> tuple[str, str, str]:
        """Return the tag of the wheel."""
        return "py3", "none", super().get_tag()[2]


class CompiledDistribution(Distribution):
    """A distribution with compiled code."""

    def has_ext_modules(self) -> bool:
        """Return True: the wheel holds a compiled library."""
        return True


setup(distclass=CompiledDistribution, cmdclass={"build_py": BuildWithFreeSpace, "bdist_wheel": PlatformWheel})
