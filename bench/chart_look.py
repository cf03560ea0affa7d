"""Colours, dashes and markers of series in PNG files and on pages."""

from __future__ import annotations

# Palette of Okabe and Ito; its colours are distinguishable with any colour vision, and by brightness in print.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
PLOTLY_MARKERS = ("circle", "square", "triangle-up", "diamond", "triangle-down", "cross", "x")
LINE_STYLES = ("-", "--", "-.", ":")
DASHES = ("solid", "dash", "dashdot", "dot", "longdash", "longdashdot")
"""Dashes of Plotly; with seven colours, combinations of colour and dash repeat after 42 series."""
REFERENCE_COLOUR = "#7F7F7F"


def marker_number(style: int) -> int:
    """Return the index of the marker of a style; each repetition of the colours uses the next marker."""
    return (style + style // len(PALETTE)) % len(MARKERS)
