"""One hypothesis profile for all tests: the same examples on every run, and no wall-clock deadline."""

from hypothesis import settings

settings.register_profile("reproducible", deadline=None, derandomize=True, print_blob=False)
settings.load_profile("reproducible")
