"""Screenshots of reports, for documents.

Run as ``python -m studies.documents.screenshots REPORT.html PICTURE.png``.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Annotated

import typer
from PIL import Image

from diffdrive_mpc.app.command_line.one_line_errors import OneLineErrors
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.whole_file import whole_file
from studies.documents.browser import open_report, opened_browser

app = typer.Typer(cls=OneLineErrors, add_completion=False)


def screenshot(
    report: Path, picture: Path, *, width: int = 1280, height: int = 1500, at: float = 0.4, browser: str | None = None
) -> None:
    """Take a screenshot of the top of a report, the cursor on the run.

    Parameters
    ----------
    report, picture
        The page, and the PNG file to write.
    width, height
        Of the window [pixels]; a height of 0 takes the whole page.
    at
        Where in the run the cursor stands, from 0 to 1.
    browser
        The browser's program; by default it is looked for on the path.

    Raises ConfigError or MissingPackageError where there is no report or no browser.
    """
    if not report.is_file():
        raise ConfigError(f"{report}: no such report")
    with whole_file(picture) as draft, opened_browser(browser) as opened:
        page = opened.new_page(viewport={"width": width, "height": height or 1000}, device_scale_factor=1)
        open_report(page, report)
        if page.locator("#time").count():
            page.locator("#time").fill(str(round(1000 * at)))
            page.locator("#time").blur()
        page.evaluate("window.scrollTo({top: 0, behavior: 'instant'})")
        shown = page.screenshot(full_page=height == 0)
        Image.open(BytesIO(shown)).convert("RGB").save(draft, "PNG", optimize=True)


@app.command()
def main(
    report: Annotated[Path, typer.Argument(help="The page.")],
    picture: Annotated[Path, typer.Argument(help="The PNG file to write.")],
    width: Annotated[int, typer.Option(min=200, help="Of the window [pixels].")] = 1280,
    height: Annotated[int, typer.Option(min=0, help="Of the window [pixels]; 0 for the whole page.")] = 1500,
    at: Annotated[float, typer.Option(min=0, max=1, help="Where in the run the cursor stands.")] = 0.4,
    browser: Annotated[str | None, typer.Option(help="Program of the browser.", show_default="on the path")] = None,
) -> None:
    """Take a screenshot of a report in a real browser."""
    screenshot(report, picture, width=width, height=height, at=at, browser=browser)


if __name__ == "__main__":
    app(prog_name="screenshots")
