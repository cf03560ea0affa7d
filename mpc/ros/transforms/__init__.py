"""Frames and the transforms between them: kept for some seconds, looked up along chains, and judged."""
