"""TeX between dollar signs, as code hosts render it, as MathML, which browsers render by themselves."""

from __future__ import annotations

import html
import re

from latex2mathml.converter import convert

# What pymdownx.arithmatex makes of $...$ and $$...$$ in its generic form.
_MARKED = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def with_mathml(page: str) -> str:
    """The HTML of a page with its formulas as MathML; raises what `convert` does where it does not understand one."""
    return _MARKED.sub(_mathml, page)


def _mathml(match: re.Match[str]) -> str:
    _, bracket, tex = match.groups()
    return str(convert(html.unescape(tex).strip(), display="block" if bracket == "[" else "inline"))
