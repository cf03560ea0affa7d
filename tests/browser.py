"""Reports in a real browser: python tests/browser.py REPORT.html PICTURE.png [WIDTH HEIGHT] takes a screenshot."""

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.errors import MissingPackageError

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
"""Program names of the browser, searched on the path."""
READY = "html[data-ready]"
"""Selector of a completely drawn page."""
_PAGE_TIMEOUT = 60_000
"""Time limit for drawing a page [ms]."""


@contextmanager
def open_browser(executable: str | None = None) -> Iterator[Any]:
    """Open a browser of Playwright.

    Parameters
    ----------
    executable
        Program of the browser; by default it is searched on the path.

    Raises MissingPackageError without Playwright, ConfigError if no browser is found.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise MissingPackageError("screenshots need playwright: pip install playwright") from error
    program = executable or next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None or shutil.which(program) is None:
        description = program or f"any of {', '.join(BROWSERS)} on the path"
        raise ConfigError(f"no browser: {description} was not found; install chromium, or name it with --browser")
    with sync_playwright() as playwright:
        # A container provides no sandbox; the page is a local file.
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        try:
            yield browser
        finally:
            browser.close()


def open_report(page: Any, report: Path) -> None:
    """Open a report in a page of Playwright and wait until it is drawn; raise ConfigError on a timeout."""
    from playwright.sync_api import TimeoutError as NotDrawnError

    page.goto(report.resolve().as_uri())
    try:
        page.wait_for_selector(READY, state="attached", timeout=_PAGE_TIMEOUT)
    except NotDrawnError as error:
        raise ConfigError(f"{report}: the page was not drawn; is it a report.html of this version?") from error


def screenshot(report: Path, picture: Path, width: int = 1280, height: int = 1500) -> None:
    """Write a screenshot of the top of a report [pixels]; a height of 0 captures the complete page."""
    if not report.is_file():
        raise ConfigError(f"{report}: no such report")
    with open_browser() as browser:
        page = browser.new_page(viewport={"width": width, "height": height or 1000}, device_scale_factor=1)
        open_report(page, report)
        page.evaluate("window.scrollTo({top: 0, behavior: 'instant'})")
        page.screenshot(path=picture, full_page=height == 0)


if __name__ == "__main__":
    screenshot(*map(Path, sys.argv[1:3]), *map(int, sys.argv[3:]))
