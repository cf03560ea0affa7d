"""Run the commands of documents unchanged where only a wheel is installed: `python .ci/tour.py PAGE...`.

The commands run in order in the current folder. Lines with `make` or `--from .` need the clone and are skipped; a YAML
block is written to its file. Only a shell and the standard library are used, so that any installation can be tested.
"""

import re
import subprocess
import sys
from pathlib import Path

FENCE = re.compile(r"^```(sh|python|yaml)\n(.*?)^```", re.MULTILINE | re.DOTALL)
SHELL = "/bin/sh"

for page in map(Path, sys.argv[1:]):
    print(f"-- {page.name}", flush=True)
    for language, body in FENCE.findall(page.read_text(encoding="utf-8")):
        if language == "yaml":
            Path(re.match(r"# file: (\S+)\n", body)[1]).write_text(body, encoding="utf-8")
        elif language == "python":
            subprocess.run(["python", "-c", body], check=True)
        else:
            lines = [line for line in body.splitlines() if not line.startswith("make ") and "--from ." not in line]
            subprocess.run([SHELL, "-e", "-x", "-c", "\n".join(lines)], check=True)
