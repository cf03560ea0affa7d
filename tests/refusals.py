"""Check of errors with a message of one line."""

from contextlib import contextmanager

import pytest


@contextmanager
def one_line_error(error_type, *parts, match=None):
    """Check that an error with a one-line message that contains all `parts` is raised; yield the exception info."""
    with pytest.raises(error_type, match=match) as error:
        yield error
    message = str(error.value)
    assert "\n" not in message
    assert all(part in message for part in parts), message
