"""Frames and the transforms between them: stored for some seconds, looked up along chains, and checked."""
