"""Opens every page of the built site in Chromium, as on a phone: usage is `check_site.py SITE`.

No page says anything on the console, asks anybody else for anything, or is wider than the screen; the search box finds
what the documents speak of; notebooks can be downloaded; a page opened as a file is readable.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

from playwright.sync_api import Page, sync_playwright
from playwright.sync_api import TimeoutError as NothingYet

PHONE = {"width": 390, "height": 844}
SOUGHT = "dead time"


class Quiet(SimpleHTTPRequestHandler):
    """A web server that says nothing."""

    def log_message(self, format: str, *args: object) -> None:
        """Keep the log of requests to itself."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve the files of `folder` by a plain web server; yield its address."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=folder)) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def watched(page: Page, home: str, faults: list[str]) -> None:
    """Add what `page` says, and whom it asks, to `faults`."""
    page.on(
        "console", lambda message: faults.append(f"{page.url}: {message.text}") if message.type == "error" else None
    )
    page.on("pageerror", lambda error: faults.append(f"{page.url}: {error}"))
    page.on(
        "request", lambda request: None if is_own(request.url, home) else faults.append(f"{page.url}: {request.url}")
    )
    page.on("response", lambda got: faults.append(f"{page.url}: {got.url} {got.status}") if got.status >= 400 else None)


def is_own(url: str, home: str) -> bool:
    """Return True if an address is that of the site, or contains its content itself."""
    return url.startswith((f"{home}/", "data:", "blob:"))


def open_all(page: Page, home: str, site: Path, faults: list[str]) -> int:
    """Open every page; returns how many there are."""
    pages = sorted(str(path.relative_to(site)) for path in site.rglob("*.html"))
    for name in pages:
        page.goto(f"{home}/{name}")
        width = page.evaluate("document.documentElement.scrollWidth")
        if width > PHONE["width"]:
            faults.append(f"{name}: {width} px wide on a screen of {PHONE['width']}")
    return len(pages)


def search(page: Page, home: str) -> str:
    """Return the title of the page behind the first result of the search box."""
    # The index is read by a worker of the page; on a busy machine it sometimes does not start, and a reader loads anew.
    for patience in (30_000, 30_000, 120_000):
        page.goto(f"{home}/index.html")
        page.locator("label.md-header__button[for=__search]").click()
        page.locator("input.md-search__input").fill(SOUGHT)
        result = page.locator("a.md-search-result__link").first
        with suppress(NothingYet):
            result.wait_for(timeout=patience)
            break
    else:
        raise AssertionError(f"nothing was found for '{SOUGHT}', in three visits of the page")
    result.click()
    page.wait_for_url(lambda url: "index.html" not in url)
    text = page.locator("article").inner_text().lower()
    assert SOUGHT in text, f"{page.url} does not speak of '{SOUGHT}'"
    return page.title()


def download(page: Page, home: str) -> int:
    """Download every tutorial's notebook by its link; returns how many there are."""
    page.goto(f"{home}/why.html")
    tutorials = {str(link.get_attribute("href")) for link in page.locator("article table a[href^='tutorials/']").all()}
    for name in tutorials:
        page.goto(f"{home}/{name}")
        with page.expect_download() as coming:
            page.locator("a[href$='.ipynb']").first.evaluate("link => { link.download = ''; link.click() }")
        assert json.loads(coming.value.path().read_text(encoding="utf-8"))["cells"], name
    return len(tutorials)


def main(site: Path) -> None:
    """Check the site; exits with what is wrong."""
    faults: list[str] = []
    with served(site) as home, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport=PHONE)
        watched(page, home, faults)
        count, title, notebooks = open_all(page, home, site, faults), search(page, home), download(page, home)
        file = browser.new_page()
        file.goto((site / "safety.html").absolute().as_uri())
        assert "BRAKING" in file.locator("article").inner_text()
        background = file.locator("header.md-header").evaluate("one => getComputedStyle(one).backgroundColor")
        assert background != "rgba(0, 0, 0, 0)", "a page opened as a file has no style"
        browser.close()
    if faults:
        sys.exit("\n".join(faults))
    print(f"{count} pages, no fault; '{SOUGHT}' leads to '{title}'; {notebooks} notebooks")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
