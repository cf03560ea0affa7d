"""Open reports that tests have left in Chromium: usage is `check_pages.py BASETEMP FOLDER...`.

Each is held against what `tests/bench/opened_report.py` asks of every report; to make them for it alone takes minutes.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "bench"))
from opened_report import check_report

left, *names = sys.argv[1:]
for name in names:
    pages = sorted(Path(left).glob(f"popen-gw*/{name}[0-9]*/**/report.html"))
    if not pages:
        sys.exit(f"{left}: no test has left a report in a folder {name}")
    check_report(pages[0])
    print(f"{name}: its report is drawn")
