"""Frames and the transforms between them: stored for several seconds, looked up along chains, and checked."""
