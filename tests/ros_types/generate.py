"""Generate the sources of a package of ROS types with the generators of ROS 2 Jazzy; `ros_types.build` runs this file.

The generators read their templates from the folders in AMENT_PREFIX_PATH.
"""

from __future__ import annotations

import sys
from pathlib import Path

from rosidl_adapter.action import convert_action_to_idl
from rosidl_adapter.msg import convert_msg_to_idl
from rosidl_generator_c.cli import GenerateC
from rosidl_generator_py.cli import GeneratePython
from rosidl_generator_type_description.cli import HashTypeDescription
from rosidl_typesupport_c.cli import GenerateCTypesupport
from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

_CONVERT = {".msg": convert_msg_to_idl, ".action": convert_action_to_idl}


def generate(package: str, definitions: Path, shares: Path, folder: Path, supports: list[str]) -> None:
    """Write Python, C and C++ sources of `package`, defined by the files in `definitions`, to `folder`.

    Parameters
    ----------
    package
        Name of the package.
    definitions
        Folder with `msg/*.msg` and `action/*.action`, absolute.
    shares
        Folder with the definitions of all other packages, one folder per package.
    folder
        New folder, absolute, with one folder per generator; `py` is that of Python.
    supports
        Names of the type supports.
    """
    files = [path.relative_to(definitions) for path in sorted(definitions.rglob("*")) if path.suffix in _CONVERT]
    plain = folder / "idl" / package
    for file in files:
        _CONVERT[file.suffix](definitions, package, file, plain / file.parent)
    interfaces = [f"{plain}:{file.with_suffix('.idl')}" for file in files]
    others = [str(shares)]
    described = HashTypeDescription("description").generate_type_hashes(package, interfaces, others, plain)
    GenerateC("c").generate(package, interfaces, others, folder / "c" / package, described)
    both = {"typesupport_implementations": supports}
    entry = {"typesupport_implementations": ["rosidl_typesupport_c"]}
    # Separate folders, because two generators use the same name for different files.
    for name, generator in {
        "fastrtps_c": GenerateFastRTPSCTypesupport("fastrtps_c"),
        "introspection_c": GenerateIntrospectionCTypesupport("introspection_c"),
        "typesupport_c": GenerateCTypesupport("c", **both),
        "py": GeneratePython("py", **entry),
    }.items():
        generator.generate(package, interfaces, others, folder / name / package)


if __name__ == "__main__":
    generate(sys.argv[1], *map(Path, sys.argv[2:5]), sys.argv[5:])
