"""What `models.plug_ins` finds of terrains."""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_mpc.models.file_kind import FileKind

if TYPE_CHECKING:
    from pydantic import BaseModel


def _reader() -> type[BaseModel]:
    from diffdrive_mpc_extras.terrain.terrain_file import Terrain  # noqa: PLC0415 - who asks for names only needs none

    return Terrain


TERRAIN = FileKind(
    "terrain", "extras", "shear and slip of a floor", "load_terrain", ("terrain/terrains/*.yaml",), reader=_reader
)
