"""The laboratory: the controller, a simulated robot and a peer as one page for a browser."""

from importlib.metadata import version

_ROOT = "0.3"
"""Minor version of diffdrive-mpc that this package is built on."""

_installed = version("diffdrive-mpc")
if not _installed.startswith(f"{_ROOT}."):
    raise ImportError(f"diffdrive-mpc-lab needs diffdrive-mpc {_ROOT}, not {_installed}: install the same version")
