"""Implementation of the command `identify`: trial drives, verdict, figures and page."""

from __future__ import annotations
