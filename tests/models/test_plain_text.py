"""Names are data: whatever they hold, they end no line, no comment, and steer no terminal."""

import yaml
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.models.identification.deliver.configuration import IdentifiedConfiguration, Setting
from diffdrive_mpc.models.table import plain_line

HOSTILE = "a\nlimits: {max_position_error: 99}\r\x1b[2J\u202e\x85\u2028b"


@given(st.text())
def test_any_text_becomes_one_line_that_can_be_printed(text):
    line = plain_line(text, longest=60)
    assert line.isprintable()
    assert len(line) <= 60
    assert len(line.splitlines()) <= 1


@given(st.text(st.characters(categories=["L", "N", "P", "S"]), max_size=60))
def test_what_is_harmless_stays(text):
    assert plain_line(text) == text


def test_what_is_cut_says_so():
    assert plain_line("x" * 100, longest=10) == "xxxxxxx..."
    assert plain_line("\n" * 10**7, longest=10) == "..."


@given(st.text())
def test_no_name_puts_keys_into_a_configuration(name):
    found = IdentifiedConfiguration(name, (Setting("sample_time", 0.02, f"from {name}"),), (), ())
    assert set(yaml.safe_load(found.text())) == {"sample_time", "limits"}


def test_a_name_with_lines_puts_nothing_into_a_configuration():
    found = IdentifiedConfiguration(HOSTILE, (Setting("sample_time", 0.02, HOSTILE),), (), ())
    assert yaml.safe_load(found.text()) == {"sample_time": 0.02, "limits": None}
