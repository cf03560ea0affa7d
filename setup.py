"""Building a wheel compiles its C into it, and makes its JSON Schemas. All else is in pyproject.toml."""

import os
import subprocess
import sys
import types
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

SOURCES = Path(__file__).parent / "src"


def bare_packages() -> None:
    """Put our packages in place without what they import themselves: a build needs CasADi, but no controller."""
    for room in ("", ".models", ".mpc", ".mpc.problem", ".sim"):
        name = f"diffdrive_mpc{room}"
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
            from diffdrive_mpc.models.compiled.compiler import NotCompiledError  # noqa: PLC0415
            from diffdrive_mpc.mpc.core.packaged import write_packaged as write_core  # noqa: PLC0415
            from diffdrive_mpc.sim.core.library import write_packaged as write_twin  # noqa: PLC0415

            package = Path(self.build_lib, "diffdrive_mpc")
            try:
                write_core(package / "mpc" / "core")
                write_twin(package / "sim" / "core")
            except NotCompiledError as error:
                sys.exit(f"error: the package's C is not compiled: {error}; install gcc, or take a wheel")
            # Plug-ins register structures of models in the metadata of the package.
            self.run_command("egg_info")
            generate = [sys.executable, "-m", "diffdrive_mpc.app.schemas", str(package.resolve())]
            subprocess.run(generate, check=True, env=os.environ | {"PYTHONPATH": str(SOURCES)})


class PlatformWheel(bdist_wheel):
    """A wheel for one platform and any Python 3: the core is a plain library, not a module of one Python."""

    def get_tag(self) -> tuple[str, str, str]:
        """Return the tag of the wheel."""
        return "py3", "none", super().get_tag()[2]


class WithLibrary(Distribution):
    """Distribution with a compiled library, which depends on the platform."""

    def has_ext_modules(self) -> bool:
        """Return True if the distribution contains compiled code."""
        return True


setup(distclass=WithLibrary, cmdclass={"build_py": BuildWithCore, "bdist_wheel": PlatformWheel})
