"""TeX between dollar signs, as code hosts render it, as MathML, which browsers render by themselves."""

from __future__ import annotations

import re

from latex2mathml.converter import convert

_CODE_OR_FORMULA = re.compile(
    r"(?P<code>^```.*?^```$|^ {4}[^\n]*$|`[^`\n]+`)|\$\$(?P<block>.+?)\$\$|\$(?P<inline>[^\s$](?:[^$\n]*[^\s$])?)\$",
    re.MULTILINE | re.DOTALL,
)


def with_mathml(markdown: str) -> str:
    """The Markdown of a page with its formulas as MathML; raises what `convert` does for bad TeX."""
    return _CODE_OR_FORMULA.sub(_mathml, markdown)


def _mathml(match: re.Match[str]) -> str:
    if match["code"]:
        return match[0]
    block = match["block"] is not None
    made = str(convert((match["block"] or match["inline"]).strip(), display="block" if block else "inline"))
    # Markdown reads on inside of tags: a star or an underscore would begin an emphasis.
    return made.replace("*", "&#42;").replace("_", "&#95;")
