"""Additional features of diffdrive-mpc: models of the papers, obstacles, planning, campaigns, export to C."""

from importlib.metadata import version

_ROOT = "0.3"
"""Minor version of diffdrive-mpc that this package is built on."""

_installed = version("diffdrive-mpc")
if not _installed.startswith(f"{_ROOT}."):
    raise ImportError(
        f"diffdrive-mpc-extras needs diffdrive-mpc {_ROOT}, not {_installed}: install both of one version"
    )
