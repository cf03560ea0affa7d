"""Which steps are done, from what, and with what result: a step of the same inputs is not done again."""

from __future__ import annotations

import hashlib
import json
import resource
from collections.abc import Callable, Iterable, Mapping
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from joblib.externals.loky import get_reusable_executor
from pydantic import Field

from diffdrive_mpc.bench.report_folder import staged
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked, parse_json
from diffdrive_mpc.models.compiled.cache import content_digest
from diffdrive_mpc.models.robot import NotNegative, Positive
from diffdrive_mpc.models.whole_file import UNFINISHED, whole_file
from diffdrive_mpc_extras.campaign.identity import environment

FILE = "commission.json"
SAID = "said.txt"
"""What a step printed."""


@dataclass(frozen=True)
class Gate:
    """Whether the next step may begin, in one sentence; without a full stop."""

    passed: bool
    sentence: str


@dataclass(frozen=True)
class Done:
    """A finished step.

    Attributes
    ----------
    key
        Hash of its inputs.
    passed, sentence
        Its gate.
    processor_s
        What it cost, processes that it started included [s].
    files
        Hash of each file that it left, by name.
    """

    key: str
    passed: bool
    sentence: str
    processor_s: float
    files: dict[str, str]


class Ledger:
    """The steps of one folder.

    Parameters
    ----------
    folder
        Of the commissioning; each step has a folder of its own name there.

    Raises
    ------
    models.checked_yaml.ConfigError
        If its file was not written by this command.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._path = folder / FILE
        try:
            data = parse_json(self._path.read_text(encoding="utf-8")) if self._path.exists() else {}
            self.steps = {str(name): Done(**step) for name, step in dict(data.get("steps", {})).items()}
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise ConfigError(f"{self._path}: not written by this command; move it away") from error

    def valid(self, name: str, key: str) -> Done | None:
        """The step, where it was done with these inputs and its files are as it left them."""
        done = self.steps.get(name)
        if done is None or done.key != key:
            return None
        place = self.folder / name
        same = all(
            (place / file).is_file() and content_digest(place / file) == hash_ for file, hash_ in done.files.items()
        )
        return done if same else None

    def carry_out(self, name: str, key: str, step: Callable[[Path], Gate], *, kept: bool = False) -> Done:
        """Do a step in its folder, which holds all of its files or those of before, and write down what came of it.

        A step that is `kept` writes into its folder directly, as one does that goes on where it was interrupted.
        What it prints goes into `SAID` beside its files.
        """
        before, place = _processor_time(), self.folder / name
        if kept:
            place.mkdir(parents=True, exist_ok=True)
            gate = _quietly(step, place)
        else:
            with staged(place) as folder:
                gate = _quietly(step, folder)
        files = {str(path.relative_to(place)): content_digest(path) for path in _files(place)}
        done = Done(key, gate.passed, gate.sentence, round(_processor_time() - before, 2), files)
        self.steps[name] = done
        content = {"steps": {one: asdict(step_) for one, step_ in self.steps.items()}}
        with whole_file(self._path) as draft:
            draft.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        return done


def key_of(name: str, options: Mapping[str, Any], inputs: Iterable[Path]) -> str:
    """The hash of a step's inputs: its name and options, the content of files and folders, product and libraries."""
    contents = {str(k): [content_digest(file) for file in _files(path)] for k, path in enumerate(inputs)}
    text = json.dumps([name, dict(options), contents, environment()], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def _files(path: Path) -> list[Path]:
    """A file, or the files of a folder; the rows of driven runs are a store of their own.

    What a killed process left unfinished does not count: it goes later, and the step would look as if it were changed.
    """
    if path.is_file():
        return [path]
    within = {entry: entry.relative_to(path).parts for entry in path.rglob("*") if entry.is_file()}
    return sorted(entry for entry, parts in within.items() if "runs" not in parts and UNFINISHED not in "/".join(parts))


def _quietly(step: Callable[[Path], Gate], folder: Path) -> Gate:
    with (folder / SAID).open("w", encoding="utf-8") as output, redirect_stdout(output):
        return step(folder)


def _processor_time() -> float:
    """Of this process and of those that it started [s], which are ended: only then the system counts them."""
    get_reusable_executor(reuse=True).shutdown(wait=True)
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


# What a commissioning drives and demands; the numbers stand in `settings.yaml`.


class DriveSettings(StrictModel):
    """A drive to identify from."""

    seconds: Positive
    speed: Positive
    yaw_rate: Positive


class Gates(StrictModel):
    """What a step must reach."""

    delay_deviation: Positive
    gain_deviation: Positive
    fit: float
    twin_behind: NotNegative


class ProofSettings(StrictModel):
    """The runs of the proof."""

    runs: int = Field(ge=1)
    first_seed: int = Field(ge=0)
    worst: int = Field(ge=0, le=99)
    spread: dict[str, tuple[Positive, Positive]]


class QuickSettings(StrictModel):
    """The short form: seconds of the drives and of the log that the twin is fitted to, runs of the proof."""

    slow: Positive
    full: Positive
    twin: Positive
    runs: int = Field(ge=1)


class MostSlip(StrictModel):
    """Of what a log may say of sideways slip."""

    side_slip: Positive
    load_shift: Positive


class CommissionSettings(StrictModel):
    """All of it."""

    slow: DriveSettings
    full: DriveSettings
    twin_seconds: Positive
    most_slip: MostSlip
    quick: QuickSettings
    gates: Gates
    proof: ProofSettings


@cache
def commission_settings() -> CommissionSettings:
    """Read the settings; raises ConfigError on a mistake in them."""
    return load_checked(CommissionSettings, Path(__file__).with_name("settings.yaml"))


# What a commissioning found, as its report says it.


STEPS = ("excite-slow", "record-slow", "learn", "excite", "record", "identify", "twin", "tune", "prove")
"""All of them, in order."""
_HEAD = """\
# Commissioning

Each step had to pass before the next one began. `model.yaml` and `config.yaml` are for the robot, `twin.yaml` is for
`simulate --plant mujoco:twin.yaml`, `proof.md` says how often runs on robots around the twin went how.

"""
_TAIL = """
## The first drive

With `config.yaml`, on its own floor, with room and a hand at the emergency stop: `first_circle.yaml` first. The proof
is of the twin and of robots around it, not of this robot: what its log did not show is not in it.
"""


def steps_table(steps: Mapping[str, Done], tuned: bool) -> Table:
    """Every step with its sentence and its cost."""
    shown = [name for name in STEPS if name in steps and (tuned or name != "tune")]
    rows = tuple((name, f"{steps[name].sentence}.", number(steps[name].processor_s, 1)) for name in shown)
    return Table("Steps", ("step", "result", "processor time [s]"), rows, 2)


def report_text(steps: Mapping[str, Done], tuned: bool) -> str:
    """`report.md`."""
    return _HEAD + steps_table(steps, tuned).markdown().rstrip() + "\n" + _TAIL
