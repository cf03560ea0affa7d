"""Independent monitor of a tracking controller: it shares no control code with the controller."""

from importlib.metadata import version

_ROOT = "0.3"
"""Minor version of diffdrive-mpc that this package is built on."""

if not version("diffdrive-mpc").startswith(f"{_ROOT}."):
    raise ImportError(
        f"diffdrive-mpc-monitor {_ROOT} needs diffdrive-mpc {_ROOT}, found {version('diffdrive-mpc')}: install both of one version"
    )
