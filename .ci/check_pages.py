"""Open reports of earlier tests in Chromium: usage is `check_pages.py BASETEMP FOLDER...`.

Each report is checked by `tests/bench/opened_report.py`. Reports of earlier tests are used because building them takes
minutes.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "bench"))
from opened_report import check_report

base, *names = sys.argv[1:]
for name in names:
    pages = sorted(Path(base).glob(f"popen-gw*/{name}[0-9]*/**/report.html"))
    if not pages:
        sys.exit(f"{base}: no test wrote a report into a folder {name}")
    check_report(pages[0])
    print(f"{name}: its report is drawn")
