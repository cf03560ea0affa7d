"""Export of the judge as C files for a microcontroller, with the rules as constants."""

from __future__ import annotations

import shutil
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.table import plain_line
from diffdrive_mpc_monitor.judge import source_texts
from diffdrive_mpc_monitor.rules import Rules

_SOURCES = Path(__file__).parent / "sources"


def export_judge(rules: Rules, folder: Path) -> list[Path]:
    """Write judge, rules, examples and a project for an STM32F4 into `folder`; returns the files.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the folder is a file.
    OSError
        If a file cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"--export {folder}: not a folder; give another path")
    shutil.copytree(_SOURCES, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
    target = folder / "ddmon"
    target.mkdir(exist_ok=True)
    for name, text in (source_texts() | rules_texts(rules)).items():
        (target / name).write_text(text, encoding="utf-8")
    return sorted(path for path in folder.rglob("*") if path.is_file())


def rules_texts(rules: Rules) -> dict[str, str]:
    """Generate rules.c and rules.h."""
    members = ",\n".join(f"    .{name} = {value!r}" for name, value in rules.numbers.items())
    comment = "".join("_" if letter in '*/\\?"' else letter for letter in plain_line(rules.name, max_length=80))
    header = (
        '#ifndef DDMON_RULES_H\n#define DDMON_RULES_H\n\n#include "judge.h"\n\n'
        f"/* {comment} */\nextern const ddmon_rules ddmon_default_rules;\n\n#endif\n"
    )
    return {
        "rules.c": f'#include "rules.h"\n\nconst ddmon_rules ddmon_default_rules = {{\n{members},\n}};\n',
        "rules.h": header,
    }
