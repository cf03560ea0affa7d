"""Colours, dashes and markers of series, the same in pictures and on pages."""

from __future__ import annotations

# Okabe and Ito's palette: distinct with every kind of colour vision, and by brightness in print.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
PLOTLY_MARKERS = ("circle", "square", "triangle-up", "diamond", "triangle-down", "cross", "x")
LINE_STYLES = ("-", "--", "-.", ":")
DASHES = ("solid", "dash", "dashdot", "dot", "longdash", "longdashdot")
"""Dashes of Plotly: with seven colours, a pair of colour and dash repeats after 42 series."""
REFERENCE_COLOUR = "#7F7F7F"


def marker_number(style: int) -> int:
    """Return the index of a style's marker; when the colours repeat, each is paired with the next marker."""
    return (style + style // len(PALETTE)) % len(MARKERS)
