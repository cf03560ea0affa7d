"""The study `peers`: every peer tuned by the same search with the same budget on the same runs, and the proof."""
