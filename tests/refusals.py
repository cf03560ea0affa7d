"""Check of errors with a message of one line."""

from contextlib import contextmanager

import pytest


@contextmanager
def one_line_error(kind, *words, match=None):
    """Check that an error is raised whose message is one line with all words; yield pytest's exception info."""
    with pytest.raises(kind, match=match) as caught:
        yield caught
    line = str(caught.value)
    assert "\n" not in line
    assert all(word in line for word in words), line
