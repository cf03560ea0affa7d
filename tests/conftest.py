"""Setup of the root package's tests; `suite` is shared with the packages' tests."""

from suite import *  # noqa: F403
