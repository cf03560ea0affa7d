"""Check of errors with a message of one line."""

from contextlib import contextmanager

import pytest


@contextmanager
def one_line_error(error_type, *parts, match=None):
    """Check that an error is raised whose message is one line with all words; yield pytest's exception info."""
    with pytest.raises(error_type, match=match) as error:
        yield error
    message = str(error.value)
    assert "\n" not in message
    assert all(part in message for part in parts), message
