"""Limits of the unpacked size of a bag, so that a small file cannot exhaust memory or disk."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.file_limits import file_limits
from diffdrive_mpc.models.input_file import MEGABYTE

MAX_UNPACKED = file_limits().bag_chunk
"""Maximum unpacked size of one chunk or message."""
MAX_RATIO, BASE_SIZE = file_limits().bag_ratio, file_limits().bag_always
"""Maximum ratio of unpacked to packed size, and unpacked size that is always permitted [bytes]."""
_REMEDY = "record it in smaller chunks, or uncompressed"


class Budget:
    """Limit of the total unpacked size of a file with `size` bytes at `path`."""

    def __init__(self, path: Path, size: int) -> None:
        self._path, self._remaining = path, max(BASE_SIZE, MAX_RATIO * size)
        self._budget = self._remaining

    def take(self, count: int) -> None:
        """Subtract `count` unpacked bytes from the budget; raise ConfigError if it is exceeded."""
        self._remaining -= count
        if self._remaining < 0:
            raise ConfigError(
                f"{self._path}: unpacks to more than {self._budget / MEGABYTE:g} MB, {MAX_RATIO} times its size; "
                "if the file is valid, convert it to an uncompressed bag (`ros2 bag convert`)"
            )


def unpack(path: Path, data: bytes | memoryview, compression: str, size: int | None = None) -> bytes | memoryview:
    """Unpack `data` of a file, up to its declared size or `MAX_UNPACKED`.

    Parameters
    ----------
    path
        The file, for messages.
    data
        The packed data.
    compression
        "zstd", "lz4", or "" for uncompressed data.
    size
        Declared size of the unpacked data [bytes]; None if unknown.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the data cannot be unpacked, exceed the limit, or differ in size from the declaration.
    """
    max_size = MAX_UNPACKED if size is None else size
    if max_size > MAX_UNPACKED:
        raise ConfigError(
            f"{path}: a chunk has {max_size / MEGABYTE:,.0f} MB, the limit is {MAX_UNPACKED / MEGABYTE:g}; {_REMEDY}"
        )
    try:
        # Request one byte more than permitted, to detect larger content without unpacking all of it.
        content = _unpack(data, compression, max_size + 1)
    except Exception as error:  # the types depend on the library
        raise ConfigError(f"{path}: a chunk cannot be unpacked ({' '.join(str(error).split())})") from error
    if len(content) > max_size or (size is not None and len(content) != size):
        raise ConfigError(f"{path}: a chunk does not unpack to its declared {max_size} bytes; is the file damaged?")
    return content


def _unpack(data: bytes | memoryview, compression: str, max_size: int) -> bytes | memoryview:
    if not compression:
        return data
    if compression == "zstd":
        from zstandard import ZstdDecompressor  # noqa: PLC0415 - needed for bags only

        return bytes(ZstdDecompressor().stream_reader(BytesIO(data), read_across_frames=True).read(max_size))
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]  # noqa: PLC0415

        return bytes(LZ4FrameDecompressor().decompress(data, max_length=max_size))
    raise ValueError(f"compression '{compression}' is not supported")
