"""Open every page of the built site in Chromium, as on a phone: usage is `check_site.py SITE`.

No page may print console errors, send requests to other hosts, or be wider than the screen. The search box must find a
page with the searched words, notebooks must download, and a page that is opened as a file must be readable.
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
SEARCH_TERM = "dead time"


class QuietHandler(SimpleHTTPRequestHandler):
    """Web server without log output."""

    def log_message(self, format: str, *args: object) -> None:
        """Discard the log message."""


@contextmanager
def serve(folder: Path) -> Iterator[str]:
    """Serve the files of `folder` on the local host; yield the address of the server."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(QuietHandler, directory=folder)) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def collect_faults(page: Page, home: str, faults: list[str]) -> None:
    """Append console errors, requests to other hosts and failed requests of `page` to `faults`."""
    page.on(
        "console", lambda message: faults.append(f"{page.url}: {message.text}") if message.type == "error" else None
    )
    page.on("pageerror", lambda error: faults.append(f"{page.url}: {error}"))
    page.on(
        "request", lambda request: None if is_own(request.url, home) else faults.append(f"{page.url}: {request.url}")
    )
    page.on("response", lambda res: faults.append(f"{page.url}: {res.url} {res.status}") if res.status >= 400 else None)


def is_own(url: str, home: str) -> bool:
    """Return True for an address of the site, or one that embeds its content."""
    return url.startswith((f"{home}/", "data:", "blob:"))


def open_all(page: Page, home: str, site: Path, faults: list[str]) -> int:
    """Open every page; return the number of pages."""
    pages = sorted(str(path.relative_to(site)) for path in site.rglob("*.html"))
    for name in pages:
        page.goto(f"{home}/{name}")
        width = page.evaluate("document.documentElement.scrollWidth")
        if width > PHONE["width"]:
            faults.append(f"{name}: {width} px wide on a screen of {PHONE['width']}")
    return len(pages)


def search(page: Page, home: str) -> str:
    """Return the title of the page behind the first result of the search box."""
    # A worker of the page reads the index; on a busy machine it sometimes does not start, so the page is loaded again.
    for patience in (30_000, 30_000, 120_000):
        page.goto(f"{home}/index.html")
        page.locator("label.md-header__button[for=__search]").click()
        page.locator("input.md-search__input").fill(SEARCH_TERM)
        result = page.locator("a.md-search-result__link").first
        with suppress(NothingYet):
            result.wait_for(timeout=patience)
            break
    else:
        raise AssertionError(f"nothing was found for '{SEARCH_TERM}', in three visits of the page")
    result.click()
    page.wait_for_url(lambda url: "index.html" not in url)
    text = page.locator("article").inner_text().lower()
    assert SEARCH_TERM in text, f"{page.url} does not contain '{SEARCH_TERM}'"
    return page.title()


def download(page: Page, home: str) -> int:
    """Download every tutorial's notebook by its link; return the number of notebooks."""
    page.goto(f"{home}/why.html")
    tutorials = {str(link.get_attribute("href")) for link in page.locator("article table a[href^='tutorials/']").all()}
    for name in tutorials:
        page.goto(f"{home}/{name}")
        with page.expect_download() as coming:
            page.locator("a[href$='.ipynb']").first.evaluate("link => { link.download = ''; link.click() }")
        assert json.loads(coming.value.path().read_text(encoding="utf-8"))["cells"], name
    return len(tutorials)


def main(site: Path) -> None:
    """Check the site; exit with the list of faults, if any."""
    faults: list[str] = []
    with serve(site) as home, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport=PHONE)
        collect_faults(page, home, faults)
        count, title, notebooks = open_all(page, home, site, faults), search(page, home), download(page, home)
        file = browser.new_page()
        file.goto((site / "safety.html").absolute().as_uri())
        assert "BRAKING" in file.locator("article").inner_text()
        background = file.locator("header.md-header").evaluate("one => getComputedStyle(one).backgroundColor")
        assert background != "rgba(0, 0, 0, 0)", "a page opened as a file has no style"
        browser.close()
    if faults:
        sys.exit("\n".join(faults))
    print(f"{count} pages, no fault; the search for '{SEARCH_TERM}' opens '{title}'; {notebooks} notebooks")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
