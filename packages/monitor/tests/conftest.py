"""Setup of these tests, shared with the root package's."""

from suite import *  # noqa: F403
