"""Building a wheel compiles the controller's core into it; all else is said in pyproject.toml."""

import sys
import types
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

SOURCES = Path(__file__).parent / "src"


def bare_packages() -> None:
    """Put our packages in place without what they import themselves: a build needs CasADi, but no controller."""
    for name in ("diffdrive_mpc", "diffdrive_mpc.models", "diffdrive_mpc.mpc", "diffdrive_mpc.mpc.problem"):
        package = types.ModuleType(name)
        package.__path__ = [str(SOURCES.joinpath(*name.split(".")))]
        sys.modules[name] = package


class BuildWithCore(build_py):
    """Copies the packages, and compiles the core into them. An editable install compiles it at first use instead."""

    def run(self) -> None:
        """Build."""
        super().run()
        if not self.editable_mode:
            bare_packages()
            from diffdrive_mpc.mpc.core.compiler import NotCompiledError  # noqa: PLC0415
            from diffdrive_mpc.mpc.core.packaged import write_packaged  # noqa: PLC0415

            try:
                write_packaged(Path(self.build_lib, "diffdrive_mpc", "mpc", "core"))
            except NotCompiledError as error:
                sys.exit(f"error: the controller's core is not compiled: {error}; install gcc, or take a wheel")


class PlatformWheel(bdist_wheel):
    """A wheel for one platform and any Python 3: the core is a plain library, not a module of one Python."""

    def get_tag(self) -> tuple[str, str, str]:
        """Tag of the wheel."""
        return "py3", "none", super().get_tag()[2]


class WithLibrary(Distribution):
    """What is installed is not the same everywhere."""

    def has_ext_modules(self) -> bool:
        """Whether there is compiled code."""
        return True


setup(distclass=WithLibrary, cmdclass={"build_py": BuildWithCore, "bdist_wheel": PlatformWheel})
