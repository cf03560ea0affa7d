"""The proof on logs of real robots: linear models against models with the effects of their base."""

from __future__ import annotations
