"""The source files of a package of ROS types, by the generators of ROS 2 Jazzy; a process of its own runs it.

They read templates from the folders that AMENT_PREFIX_PATH names, and print what they do.
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

from diffdrive_mpc.app.ros_types.build import TYPE_SUPPORTS

_CONVERT = {".msg": convert_msg_to_idl, ".action": convert_action_to_idl}


def generate(package: str, definitions: Path, shares: Path, folder: Path) -> None:
    """Write Python, C and C++ of `package`, defined by the files in `definitions`, to `folder`.

    Parameters
    ----------
    package
        Its name.
    definitions
        Folder with `msg/*.msg` and `action/*.action`, absolute.
    shares
        Where the definitions of all other packages are, one folder for each.
    folder
        A new folder, absolute: it gets one folder for each generator, `py` for that of Python.
    """
    files = [path.relative_to(definitions) for path in sorted(definitions.rglob("*")) if path.suffix in _CONVERT]
    plain = folder / "idl" / package
    for file in files:
        _CONVERT[file.suffix](definitions, package, file, plain / file.parent)
    interfaces = [f"{plain}:{file.with_suffix('.idl')}" for file in files]
    others = [str(shares)]
    described = HashTypeDescription("description").generate_type_hashes(package, interfaces, others, plain)
    GenerateC("c").generate(package, interfaces, others, folder / "c" / package, described)
    both = {"typesupport_implementations": list(TYPE_SUPPORTS)}
    entry = {"typesupport_implementations": ["rosidl_typesupport_c"]}
    # In folders of their own: two generators give the same name to different files.
    for name, generator in {
        "fastrtps_c": GenerateFastRTPSCTypesupport("fastrtps_c"),
        "introspection_c": GenerateIntrospectionCTypesupport("introspection_c"),
        "typesupport_c": GenerateCTypesupport("c", **both),
        "py": GeneratePython("py", **entry),
    }.items():
        generator.generate(package, interfaces, others, folder / name / package)


if __name__ == "__main__":
    _package, *_folders = sys.argv[1:]
    generate(_package, *map(Path, _folders))
