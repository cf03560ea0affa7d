"""What MkDocs calls while it builds the site (`hooks` of mkdocs.yml)."""

from __future__ import annotations

import logging
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from diffdrive_mpc.app.lab.build import has_compiler, page_text
from studies.site.formulas import with_mathml
from studies.site.reference import reference_pages
from studies.site.repository_links import pages_outside, with_site_links

_LABORATORY = "lab.html"
_NO_COMPILER = "the laboratory is not on this site: its compiler is not installed (make lab installs it)"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what does not lie in `docs`: pages of the repository's top, the reference, and the laboratory."""
    root = Path(config.config_file_path).parent
    documents = {f"docs/{file.src_uri}": file.content_string for file in files.documentation_pages()}
    for place, text in {**pages_outside(root, documents), **reference_pages(documents)}.items():
        files.append(File.generated(config, place, content=text))
    files.append(File.generated(config, _LABORATORY, content=laboratory_page()))
    return files


def laboratory_page() -> str:
    """The page of the laboratory, or a line in its place where its compiler is not installed."""
    if has_compiler():
        return page_text()
    logging.getLogger("mkdocs.hooks.laboratory").info(_NO_COMPILER)
    head = "<!DOCTYPE html><html lang=en><meta name=viewport content=width=device-width><title>Laboratory</title>"
    return f"{head}<p>{_NO_COMPILER}</p></html>"


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Turn links to files of the repository into links of the site; generated pages have them already."""
    if page.file.generated_by is not None:
        return markdown
    return with_site_links(markdown, f"docs/{page.file.src_uri}")


def on_page_content(html: str, **_: object) -> str:
    """Render formulas."""
    return with_mathml(html)
