"""Install launch and parameter files, and the node under the name that `ros2 run` looks for."""

from pathlib import Path
from xml.etree import ElementTree

from setuptools import setup

HERE = Path(__file__).parent
PACKAGE = ElementTree.parse(HERE / "package.xml").getroot()
NAME = PACKAGE.findtext("name")
SHARE = f"share/{NAME}"


def files(folder: str) -> list[str]:
    """List the files of a folder for setuptools, relative to this one."""
    return sorted(str(path.relative_to(HERE)) for path in (HERE / folder).iterdir() if path.is_file())


setup(
    name=NAME,
    version=PACKAGE.findtext("version"),
    description=PACKAGE.findtext("description"),
    license=PACKAGE.findtext("license"),
    packages=[],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (SHARE, ["package.xml"]),
        (f"{SHARE}/launch", files("launch")),
        (f"{SHARE}/config", files("config")),
        (f"{SHARE}/security", files("security")),
    ],
    entry_points={"console_scripts": ["node = diffdrive_mpc.mpc.ros.main:main"]},
)
