"""Reports opened in a real browser without a network, and checks of every report."""

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from browser import open_browser, open_report

PHONE, DESKTOP = {"width": 390, "height": 844}, {"width": 1280, "height": 900}


@contextmanager
def open_offline(report: Path) -> Iterator[Any]:
    """Open the report in a page of Playwright; check that no errors and no requests occurred."""
    errors: list[str] = []
    requests: list[str] = []
    with open_browser() as browser:
        page = browser.new_context(viewport=DESKTOP, offline=True).new_page()
        page.on("console", lambda message: errors.append(message.text))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        open_report(page, report)
        yield page
        assert errors == []
        assert [url for url in requests if not url.startswith("data:")] == [report.resolve().as_uri()]


def check_report(report: Path) -> dict[str, Any]:
    """Check the page of a report; return its content."""
    with open_offline(report) as page:
        check_page(page)
    return content_of(report)


def check_page(page: Any) -> None:
    """Check that all plots are drawn, nothing is wider than a phone, and the print view shows no buttons."""
    assert page.locator("#key-figures .value").count() >= 1
    assert page.locator("#repeat pre").inner_text().strip()
    plots = page.locator(".plot")
    assert all(plots.nth(i).locator(".main-svg").count() for i in range(plots.count()))
    page.set_viewport_size(PHONE)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    page.emulate_media(media="print")
    script = "[...document.querySelectorAll('input, button, nav')].filter((item) => item.offsetParent !== null).length"
    assert page.evaluate(script) == 0
    page.emulate_media(media="screen")
    page.set_viewport_size(DESKTOP)


def content_of(report: Path) -> dict[str, Any]:
    """Return the content that the script of a report receives."""
    match = re.search(r'<script id="content" type="application/json">(.*?)</script>', report.read_text(), re.DOTALL)
    assert match
    content: dict[str, Any] = json.loads(match[1])
    return content
