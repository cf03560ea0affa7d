"""Identification for the command line: trial drives, verdict, figures and page."""

from __future__ import annotations
