"""Open reports in Chromium: usage is `check_pages.py FOLDER...`; each folder contains a `report.html`.

Each report is checked by `tests/bench/opened_report.py`. Reports of earlier steps are used because building them takes
minutes.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "bench"))
from opened_report import check_report

for folder in map(Path, sys.argv[1:]):
    page = next(folder.rglob("report.html"), None)
    if page is None:
        sys.exit(f"{folder}: no earlier step wrote a report.html into this folder")
    check_report(page)
    print(f"{folder.name}: its report is drawn")
