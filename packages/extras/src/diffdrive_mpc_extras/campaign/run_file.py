"""One run as a file: what defines it and the figures that it came to; `diffdrive-mpc repeat` drives it again."""

from __future__ import annotations

from pathlib import Path

import yaml
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc_extras.campaign.definition import Definition
from diffdrive_mpc_extras.campaign.draws import Value
from diffdrive_mpc_extras.campaign.drive import TIME, Row
from diffdrive_mpc_extras.campaign.engine import CampaignRun
from diffdrive_mpc_extras.campaign.identity import environment, key_of

_HEAD = "# A run: drive it again with `diffdrive-mpc repeat FILE`. Units are those of the files and options.\n"


class RunFile(StrictModel):
    """What stands in the file."""

    run: str = Field(description="hash of the run")
    factors: dict[str, Value] = Field(description="what defines it; what is left out has its default")
    figures: dict[str, bool | int | float | str | None] = Field(description="its row, without times")
    environment: dict[str, str] = Field(description="product, libraries and machine that it was driven on")

    @property
    def definition(self) -> Definition:
        """The run."""
        return Definition.of(self.factors)


def write_run(driven: CampaignRun, path: Path) -> None:
    """Write a run; raises ConfigError if `path` cannot be written to."""
    usual = Definition.of({}).factors
    factors = {
        name: value
        for name, value in driven.definition.factors.items()
        if value is not None and (name not in usual or value != usual[name] or name == "seed")
    }
    figures = {name: value for name, value in driven.row.items() if not name.startswith(TIME)}
    data = {"run": driven.key, "factors": factors, "figures": figures, "environment": environment()}
    with whole_file(path) as draft:
        text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=120)
        draft.write_text(_HEAD + text, encoding="utf-8")


def load_run(path: str | Path) -> RunFile:
    """Read a run; raises ConfigError when the file has a mistake."""
    return load_checked(RunFile, path)


def compared(stored: RunFile, row: Row) -> tuple[bool, str]:
    """Whether a row has the figures of the file, and a sentence on it."""
    again = {name: value for name, value in row.items() if not name.startswith(TIME)}
    other = [name for name in stored.figures if stored.figures[name] != again.get(name)]
    if not other:
        return True, f"all {len(stored.figures)} figures are those of the file, to the last bit"
    name = other[0]
    first = f"{name} is {again.get(name)}, was {stored.figures[name]}"
    return False, f"{len(other)} of {len(stored.figures)} figures are other ones: {first}; {_why(stored)}"


def _why(stored: RunFile) -> str:
    now = environment()
    changed = [name for name, value in stored.environment.items() if now.get(name) != value]
    if changed:
        was = ", ".join(
            f"{name} ({_brief(stored.environment[name])}, now {_brief(now.get(name, '-'))})" for name in changed
        )
        return f"other than then: {was}"
    if key_of(stored.definition) != stored.run:
        return "a file that it names has changed"
    return "product, libraries and files are the same: is the processor of another kind?"


def _brief(text: str) -> str:
    return text[:12]
