"""Limits of the size of an unpacked bag, so that a small file can fill neither memory nor disk."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.file_limits import file_limits
from diffdrive_mpc.models.input_file import MEGABYTE

MOST_UNPACKED = file_limits().bag_chunk
"""Maximum unpacked size of one chunk or message."""
MOST_RATIO, ALWAYS = file_limits().bag_ratio, file_limits().bag_always
"""Maximum ratio of unpacked to packed size, and a size that is always permitted."""
_SMALLER = "record it in smaller chunks, or uncompressed"


class Budget:
    """Remaining unpacked size of a file of `size` bytes at `path`."""

    def __init__(self, path: Path, size: int) -> None:
        self._path, self._left = path, max(ALWAYS, MOST_RATIO * size)
        self._most = self._left

    def take(self, count: int) -> None:
        """Count unpacked bytes; raise ConfigError if they are too many for such a file."""
        self._left -= count
        if self._left < 0:
            raise ConfigError(
                f"{self._path}: unpacks to more than {self._most / MEGABYTE:g} MB, {MOST_RATIO} times its size; "
                "if it is sound, convert it to an uncompressed bag (`ros2 bag convert`)"
            )


def unpacked(path: Path, data: bytes | memoryview, how: str, size: int | None = None) -> bytes | memoryview:
    """Unpack `data` of a file, with no more memory than that takes and `MOST_UNPACKED` at most.

    Parameters
    ----------
    path
        The file, for messages.
    data
        The packed data.
    how
        "zstd", "lz4", or "" for data that are not packed.
    size
        Declared size of the unpacked data [bytes]; None without one.

    Raises
    ------
    models.checked_yaml.ConfigError
        If its unpacked size or content differs from the declared one.
    """
    most = MOST_UNPACKED if size is None else size
    if most > MOST_UNPACKED:
        raise ConfigError(
            f"{path}: a chunk of {most / MEGABYTE:,.0f} MB, at most {MOST_UNPACKED / MEGABYTE:g} are read; {_SMALLER}"
        )
    try:
        content = _unpack(data, how, most + 1)
    except Exception as error:  # each library has its own
        raise ConfigError(f"{path}: a chunk cannot be unpacked ({' '.join(str(error).split())})") from error
    if len(content) > most or (size is not None and len(content) != size):
        raise ConfigError(f"{path}: a chunk does not unpack to the {most} bytes that it says; is the file damaged?")
    return content


def _unpack(data: bytes | memoryview, how: str, most: int) -> bytes | memoryview:
    if not how:
        return data
    if how == "zstd":
        from zstandard import ZstdDecompressor  # noqa: PLC0415 - only who reads bags needs it

        return bytes(ZstdDecompressor().stream_reader(BytesIO(data), read_across_frames=True).read(most))
    if how == "lz4":
        from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]  # noqa: PLC0415

        return bytes(LZ4FrameDecompressor().decompress(data, max_length=most))
    raise ValueError(f"it is packed by '{how}'")
