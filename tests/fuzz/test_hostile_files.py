"""Malicious files are read or rejected within limits of processor time and memory."""

import os
import resource

import pytest

from diffdrive_mpc import load_trajectory
from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.logs.reading import read_log
from diffdrive_mpc.models.logs.tick_record import DriveRecord
from fuzz.yaml_files import LOADERS

SECONDS, MEMORY = 5, 1_000_000
"""Limits of processor time [s] and peak memory [kB]."""
HEAD = "t,v,w,v2,w2\n"
MAPPING = "columns: {time: t, command: {v: v, omega: w}, encoders: {v: v2, omega: w2}}\n"
READERS = {
    **LOADERS,
    "log": lambda path: read_log(path, path.with_name("mapping.yaml")),
    "path": load_trajectory,
    "ticks": lambda path: DriveRecord.read(path.read_text(encoding="utf-8")),
}
TEXTS = {
    ("controller", "nesting"): lambda: "[" * 1_000_000,
    ("model", "number"): lambda: "a: " + "9" * 4_000_000,
    ("trajectory", "aliases"): lambda: "\n".join(f"a{i}: &a{i} [{f'*a{i - 1}, ' * 10 if i else 0}]" for i in range(40)),
    ("mapping", "merges"): lambda: (
        "a0: &a0 {k: 1}\n"
        + "\n".join(f"a{i}: &a{i}\n  <<: [{', '.join([f'*a{i - 1}'] * 10)}]\n  k{i}: 1" for i in range(1, 30))
    ),
    ("scenario", "keys"): lambda: "".join(f"key{i}: {i}\n" for i in range(400_000)),
    ("experiment", "long text"): lambda: "name: " + "x" * 20_000_000,
    ("stated-robot", "tag"): lambda: "a: !!binary A" + "A" * 9_000_000,
    ("ticks", "nesting"): lambda: '{"a":' * 5_000_000,
    ("log", "times"): lambda: HEAD + "".join(f"{k % 2},{k % 7},1,{k % 5},2\n" for k in range(120_000)),
    ("log", "columns"): lambda: ",".join(f"c{i}" for i in range(1_000_000)) + "\n",
    ("log", "quote"): lambda: HEAD + '"' + "1,2\n" * 5_000_000,
    ("log", "zeros"): lambda: HEAD + "\0" * 20_000_000,
    ("path", "same times"): lambda: "t,x,y,theta\n" + "1,2,3,4\n" * 100_000,
}


@pytest.mark.parametrize(("kind", "attack"), TEXTS)
def test_malicious_file_is_handled_within_the_limits(kind, attack, tmp_path):
    """Read the file in a separate process, whose processor time is limited by the kernel."""
    path = tmp_path / ("file.csv" if kind in ("log", "path") else "file.yaml")
    path.write_text(TEXTS[kind, attack](), encoding="utf-8")
    (tmp_path / "mapping.yaml").write_text(MAPPING, encoding="utf-8")
    child = os.fork()
    if child == 0:
        usage_before = resource.getrusage(resource.RUSAGE_SELF)
        seconds = int(usage_before.ru_utime + usage_before.ru_stime) + SECONDS + 1
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        code = 1
        try:
            READERS[kind](path)
            code = 0
        except (DiffdriveMpcError, ValueError) as error:
            code = 0 if 0 < len(str(error)) <= 4000 and str(error).isprintable() else 2
        finally:
            os._exit(code)
    _, status, usage = os.wait4(child, 0)
    assert os.waitstatus_to_exitcode(status) == 0
    assert usage.ru_maxrss < MEMORY
