"""Untrusted configurations: a term that exits is refused, and checks run no code."""

import pytest

from diffdrive_mpc import ConfigError, Controller, load_config
from untrusted_files import call, write_untrusted_files


@pytest.fixture
def untrusted(tmp_path):
    """Folder of untrusted files."""
    return write_untrusted_files(tmp_path / "stranger")


@pytest.mark.parametrize("error", ["SystemExit", "SystemExit(0)", "GeneratorExit", "type('Own', (BaseException,), {})"])
def test_term_that_exits_is_refused_with_one_line(error, untrusted):
    (untrusted / "term.py").write_text(f"raise {error}\n")
    code, output, _ = call("simulate", "--config", untrusted / "config.yaml", "--plant", "model:ssm")
    assert code == 2 and f"{untrusted}/term.py: its execution fails with" in output, output
    with pytest.raises(ConfigError, match="its execution fails with"):
        Controller(load_config(untrusted / "config.yaml"))


def test_config_check_names_the_python_of_terms_and_does_not_run_it(untrusted):
    code, output, _ = call("config", "check", untrusted / "config.yaml")
    assert (code, (untrusted / "marker").exists()) == (0, False)
    assert f"not run: {untrusted / 'term.py'}" in output
    (untrusted / "term.py").unlink()
    code, output, _ = call("config", "check", untrusted / "config.yaml")
    assert code == 2 and "no such Python file" in output
