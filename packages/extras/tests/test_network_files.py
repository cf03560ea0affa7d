"""Weights of networks in files: pickles are never loaded, and files that unpack to large content are refused."""

import hashlib
import io
import json
import pickle
import re
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import yaml

from diffdrive_mpc import ConfigError, load_model
from diffdrive_mpc.models.load import model_path

NETWORK = model_path("lstm")
MAX_EXTRA_MEMORY = 120.0
"""Memory [MB] above that of a command that loads a network; each file below would need 1,000 to 5,000."""
MEASURE = """
import json, resource, sys
from typer.testing import CliRunner
from diffdrive_mpc.app.cli import app
resource.setrlimit(resource.RLIMIT_AS, (4_000_000_000, 4_000_000_000))
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
for words in sys.stdin.read().splitlines():
    result = CliRunner().invoke(app, words.split())
    print(json.dumps([result.exit_code, type(result.exception).__name__, result.output, peak()]))
"""


class Fatal:
    """Object that ends the process when it is unpickled."""

    def __reduce__(self):
        return sys.exit, ("unpickled",)


def write_network(folder, packed, weights=None, name="network", **architecture):
    """Write the file of a network with `packed` as its weights; return its path."""
    data = yaml.safe_load(NETWORK.read_text(encoding="utf-8"))
    data |= {"weights": weights or f"{name}.npz", "sha256": hashlib.sha256(packed).hexdigest()}
    data["architecture"] |= architecture
    (folder / f"{name}.npz").write_bytes(packed)
    (folder / f"{name}.yaml").write_text(yaml.safe_dump(data))
    return folder / f"{name}.yaml"


def archive(**arrays):
    """Return the shipped weights as an npz archive, with some arrays replaced."""
    buffer = io.BytesIO()
    with (
        zipfile.ZipFile(NETWORK.with_suffix(".npz")) as source,
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for name in source.namelist():
            packed.writestr(name, arrays.get(name.removesuffix(".npy"), source.read(name)))
    return buffer.getvalue()


def array(shape, content=b"", kind="<f8"):
    """Return an array in NumPy's format, whose declared size may exceed its content."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": kind, "fortran_order": False, "shape": shape})
    return file.getvalue() + content


def test_pickles_and_foreign_files_in_place_of_weights_are_refused(tmp_path):
    objects = io.BytesIO()
    np.savez(objects, input_0=np.array([Fatal()], dtype=object))
    for content in (objects.getvalue(), pickle.dumps(Fatal()), b"import os\n"):
        with pytest.raises(ConfigError):
            load_model(write_network(tmp_path, content))
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "evil.npz", "../evil.npz"):
        with pytest.raises(ConfigError):
            load_model(write_network(tmp_path / "folder", b"", weights=str(path)))


def test_small_files_of_large_content_are_refused_without_memory(tmp_path):
    valid = NETWORK.with_suffix(".npz").read_bytes()
    encrypted = re.sub(rb"(PK\x01\x02.{4})..", lambda match: match[1] + b"\1\0", archive(), flags=re.DOTALL)
    bombs = [
        *((valid, {key: 10**9}, "architecture") for key in ("window", "units")),
        (archive(dense=array((10_000_000,), bytes(80_000_000))), {}, "bytes, at most"),
        (valid + bytes(1_000_000), {}, "larger than"),
        (archive(dense=array((10**12,))), {}, "shape"),
        (archive(dense=array((30, 32), kind="|O")), {}, "object"),
        (archive(dense=b"\x93NUMPY\1\0\xff\x1f" + b"(" * 0x1FFF), {}, "weights"),
        (encrypted, {}, "encrypted"),
    ]
    files = [write_network(tmp_path, packed, name=f"{k}", **sizes) for k, (packed, sizes, _) in enumerate(bombs)]
    result = subprocess.run(
        [sys.executable, "-c", MEASURE],
        input="\n".join(f"models show {name}" for name in ("lstm", *files)),
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    (_, _, _, baseline), *results = map(json.loads, result.stdout.splitlines())
    for (_, _, message), (code, error_type, output, peak) in zip(bombs, results, strict=True):
        assert (code, error_type) == (2, "SystemExit"), output
        assert message in output and output.startswith("error: ") and output.count("\n") == 1, output
        assert peak < baseline + MAX_EXTRA_MEMORY, (output, peak, baseline)
