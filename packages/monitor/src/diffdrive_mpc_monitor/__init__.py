"""Independent monitor of a tracking controller: it shares no control code with the controller."""

from importlib.metadata import version

_ROOT = "0.3"
"""Minor version of diffdrive-mpc that this package is built on."""

_installed = version("diffdrive-mpc")
if not _installed.startswith(f"{_ROOT}."):
    raise ImportError(
        f"diffdrive-mpc-monitor needs diffdrive-mpc {_ROOT}, not {_installed}: install both of one version"
    )
