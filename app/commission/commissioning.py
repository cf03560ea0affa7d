"""The whole of a commissioning: its steps in order, each done once, each gated by the one before."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from diffdrive_mpc.app.commission import chain
from diffdrive_mpc.app.commission.chain import DRIVE, LOG, Logs
from diffdrive_mpc.app.commission.ledger import (
    SAID,
    Done,
    DriveSettings,
    Gate,
    Ledger,
    commission_settings,
    key_of,
    report_text,
)
from diffdrive_mpc.app.identification.trial_drives import FIRST_CIRCLE
from diffdrive_mpc.app.tune.search import import_optuna
from diffdrive_mpc.app.tune.tune_file import load_plan
from diffdrive_mpc.bench.report_folder import alone_in, staged
from diffdrive_mpc.models.checked_yaml import ConfigError, read_yaml
from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.identification.deliver.configuration import CONFIG_FILE, MODEL_FILE
from diffdrive_mpc.models.load import is_shipped
from diffdrive_mpc.models.logs.bags import is_bag
from diffdrive_mpc.models.logs.drive_log.reader import is_drive_log
from diffdrive_mpc.models.logs.mapping import load_mapping
from diffdrive_mpc.models.logs.mapping_changes import mapping_text
from diffdrive_mpc.models.named_file import named_file
from diffdrive_mpc.models.stated_robot import FOLDER as MAKERS
from diffdrive_mpc.models.stated_robot import load_stated_robot
from diffdrive_mpc.models.whole_file import new_folder
from diffdrive_mpc.sim.plants.simulated_robot import ROBOTS, SimulatedRobot, load_simulated_robot
from diffdrive_mpc_extras.excitation.model_excitation import Room
from diffdrive_mpc_extras.twin.report import PLANT

RESULT = "robot"
"""Folder of what is to be used: model, configuration, twin, proof, report."""
RECORDED = ("record-slow", "record")
"""Steps for which the robot drives."""
TWIN_FILE, REPORT = "twin.yaml", "report.md"


@dataclass(frozen=True)
class CommissionRequest:
    """What is to be commissioned, and how.

    Attributes
    ----------
    room
        Where it drives.
    robot
        Robot file of the physics, a name or a path, which stands in for the robot; None where a person drives.
    config
        What drives it at first: a file, or the shipped one of a model.
    known
        Robot file with what is known of the robot, for the twin.
    stated
        Name of a robot whose maker's statements bound the configuration, and name the topics of bags; or a file.
    logs, mapping
        What a person recorded at the step that asks for it.
    slow, full
        The two drives.
    runs
        Of the proof.
    tuned
        Whether weights are tuned on the twin.
    plan
        Of the tuning; None for the shipped one.
    twin_seconds
        Of the log that the twin is fitted to [s].
    scaled
        Whether paths of the proof are scaled to the robot.
    seed
        Of searches and of the noise of the drives.
    jobs
        Processes; None for one for each core.
    """

    room: Room
    robot: str | None = None
    config: str = "ssm"
    known: str | None = None
    logs: tuple[Path, ...] = ()
    mapping: str | None = None
    stated: str | None = None
    slow: DriveSettings = field(default_factory=lambda: commission_settings().slow)
    full: DriveSettings = field(default_factory=lambda: commission_settings().full)
    runs: int = field(default_factory=lambda: commission_settings().proof.runs)
    tuned: bool = True
    plan: str | None = None
    twin_seconds: float = field(default_factory=lambda: commission_settings().twin_seconds)
    scaled: bool = False
    seed: int = 0
    jobs: int | None = None

    def quick(self) -> CommissionRequest:
        """The same in the short form, without tuning: it shows that the chain works, and proves little."""
        short = commission_settings().quick
        return replace(
            self,
            slow=self.slow.model_copy(update={"seconds": short.slow}),
            full=self.full.model_copy(update={"seconds": short.full}),
            twin_seconds=short.twin,
            runs=short.runs,
            tuned=False,
        )


MAPPING = "mapping.yaml"
"""The maker's topics, in the folder of a commissioning of bags."""


@dataclass(frozen=True)
class Step:
    """A step that is ready to be done: what its key covers, and the function of its folder."""

    name: str
    options: dict[str, Any]
    inputs: tuple[Path, ...]
    act: Callable[[Path], Gate]
    kept: bool = False


class NeedsAPersonError(DiffdriveMpcError):
    """The robot has to be driven before the next step; the message says how."""


def _check_known(path: Path) -> None:
    """Refuse what is no part of a robot file; its numbers are checked with those that the log tells."""
    known = read_yaml(path)
    keys = list(SimulatedRobot.model_fields)
    if not isinstance(known, Mapping) or not set(known) <= set(keys):
        raise ConfigError(f"--known {path}: it holds something else than what is known of a robot: {', '.join(keys)}")


def commission(
    request: CommissionRequest,
    out: Path,
    *,
    one_step: bool = False,
    on_step: Callable[[str, Done, bool], None] = lambda *_: None,
) -> bool:
    """Do the steps that are not done, up to the first that does not pass; write `RESULT` in the end.

    Parameters
    ----------
    request
        What.
    out
        Folder; each step has one of its own in it, and `commission.json` says what is done.
    one_step
        Whether to do only the next step that is not done.
    on_step
        Called with the name of each step, what came of it, and whether it was done just now.

    Returns
    -------
    bool
        Whether all steps passed that were looked at.

    Raises
    ------
    NeedsAPersonError
        Where a person has to drive.
    models.checked_yaml.ConfigError, ValueError, OSError
        If something that is named cannot be used, or another commissioning writes into `out`; what was done before
        stays.
    """
    if request.robot is not None:
        load_simulated_robot(request.robot)
    if request.known is not None:
        _check_known(named_file("robot", ROBOTS, request.known))
    if request.mapping is not None:
        load_mapping(request.mapping)
    if request.stated is not None:
        load_stated_robot(request.stated)
    if request.tuned:
        import_optuna()
        if request.plan is not None:
            load_plan(Path(request.plan))
    # Two at once would take what the other recorded, and each write down its own steps alone.
    with new_folder(out), alone_in(out, out):
        return _carry_out(request, out, one_step, on_step)


def _carry_out(
    request: CommissionRequest, out: Path, one_step: bool, on_step: Callable[[str, Done, bool], None]
) -> bool:
    """Do the steps as `commission` says, with `out` for itself."""
    request = with_stated_topics(request, out)
    ledger, fresh = Ledger(out), list(request.logs)
    for step in _steps(request, out, ledger, fresh):
        key = key_of(step.name, step.options | commission_settings().gates.model_dump(), step.inputs)
        done = ledger.valid(step.name, key)
        new = done is None
        if done is None:
            done = ledger.carry_out(step.name, key, step.act, kept=step.kept)
            if step.name in RECORDED:
                fresh.clear()  # a log is of one drive
        on_step(step.name, done, new)
        if not done.passed:
            return False
        if one_step and new and step.name != "prove":
            return True
    _finish(request, out, ledger)
    return True


def with_stated_topics(request: CommissionRequest, out: Path) -> CommissionRequest:
    """The same with the maker's topics as the mapping of bags, kept in `out` for the steps to come."""
    if request.stated is None or request.mapping is not None:
        return request
    file = out / MAPPING
    if any(is_bag(log) and not is_drive_log(log) for log in request.logs):
        file.write_text(mapping_text(load_stated_robot(request.stated).mapping()), encoding="utf-8")
    return replace(request, mapping=str(file)) if file.is_file() else request


def _steps(request: CommissionRequest, out: Path, ledger: Ledger, fresh: list[Path]) -> Iterator[Step]:
    """The steps in order; each is made when those before are done."""
    size = {"room": [request.room.length, request.room.width], "seed": request.seed}
    start = () if is_shipped(request.config) else (Path(request.config),)
    # What the maker states bounds what is learned and identified.
    maker = () if request.stated is None else (named_file("robot", MAKERS, request.stated),)
    named = {"config": request.config if is_shipped(request.config) else ""}
    slow, full = out / "record-slow", out / "record"

    yield Step(
        "excite-slow",
        size | named | request.slow.model_dump(),
        start,
        partial(chain.excite, config=request.config, room=request.room, settings=request.slow, seed=request.seed),
    )
    yield _recorded("record-slow", request, out / "excite-slow" / DRIVE, request.config, start, ledger, fresh)
    logs = _logs(slow, request)
    yield Step("learn", named, (slow, *start, *maker), partial(chain.learn, logs=logs, config=request.config))
    config = out / "learn" / CONFIG_FILE
    yield Step(
        "excite",
        size | request.full.model_dump(),
        (out / "learn",),
        partial(chain.excite, config=str(config), room=request.room, settings=request.full, seed=request.seed),
    )
    yield _recorded("record", request, out / "excite" / DRIVE, str(config), (out / "learn",), ledger, fresh)
    whole = _logs(full, request)
    both = replace(whole, files=(*whole.files, *logs.files))
    yield Step("identify", {}, (slow, full, *maker), partial(chain.identify_all, logs=both))
    yield Step(
        "twin",
        {"seconds": request.twin_seconds},
        (full, *(() if request.known is None else (named_file("robot", ROBOTS, request.known),))),
        partial(chain.twin, logs=whole, robot=request.known, jobs=request.jobs, seconds=request.twin_seconds),
    )
    chosen, plant = out / "identify" / CONFIG_FILE, out / "twin" / PLANT
    if request.tuned:
        plan = () if request.plan is None else (Path(request.plan),)
        yield Step(
            "tune",
            {},
            (out / "identify", plant, *plan),
            partial(chain.tuned, config=chosen, plant=plant, plan=request.plan, jobs=request.jobs),
            kept=True,
        )
        chosen = out / "tune" / CONFIG_FILE
    yield Step(
        "prove",
        {"runs": request.runs, "scaled": request.scaled} | commission_settings().proof.model_dump(),
        (chosen, out / "identify" / MODEL_FILE, plant),
        partial(chain.prove, config=chosen, plant=plant, runs=request.runs, jobs=request.jobs, scaled=request.scaled),
        kept=True,
    )


def _recorded(
    name: str,
    request: CommissionRequest,
    drive: Path,
    config: str,
    inputs: tuple[Path, ...],
    ledger: Ledger,
    fresh: list[Path],
) -> Step:
    """The step that drives: on the simulated robot, or by a person, whose logs are taken once."""
    if request.robot is not None:
        file = named_file("robot", ROBOTS, request.robot)
        act = partial(
            chain.record, config=config, room=request.room, drive=drive, plant=f"mujoco:{file}", seed=request.seed
        )
        return Step(name, {"seed": request.seed}, (drive, file, *inputs), act)
    key_inputs = (drive,)
    taken = ledger.valid(name, key_of(name, commission_settings().gates.model_dump(), key_inputs))
    if taken is None and not fresh:
        length, width = f"{request.room.length:g}", f"{request.room.width:g}"
        raise NeedsAPersonError(
            f"drive {drive} on the robot, with the configuration {config} and in it fence: {{enabled: true, length: "
            f"{length}, width: {width}, frame: start}}; it begins in the middle of the room, its length ahead. Record "
            "commands, encoders, gyro and poses, and call again with --log LOG"
        )
    logs = Logs(tuple(fresh), request.mapping)
    return Step(name, {}, key_inputs, partial(chain.take, logs=logs))


def _logs(folder: Path, request: CommissionRequest) -> Logs:
    """What a step recorded."""
    if request.robot is not None:
        return Logs((folder / LOG,), stated=request.stated)
    files = tuple(sorted(entry for entry in folder.iterdir() if entry.name != SAID and not entry.name.startswith(".")))
    return Logs(files, request.mapping, request.stated)


def _finish(request: CommissionRequest, out: Path, ledger: Ledger) -> None:
    """Put what is to be used into one folder."""
    config = out / ("tune" if request.tuned else "identify") / CONFIG_FILE
    words = re.sub(r"(?m)^model: \S+", f"model: {MODEL_FILE}", config.read_text(encoding="utf-8"), count=1)
    with staged(out / RESULT) as folder:
        shutil.copy2(out / "identify" / MODEL_FILE, folder / MODEL_FILE)
        shutil.copy2(out / "identify" / FIRST_CIRCLE, folder / FIRST_CIRCLE)
        (folder / CONFIG_FILE).write_text(words, encoding="utf-8")
        shutil.copy2(out / "twin" / PLANT, folder / TWIN_FILE)
        shutil.copy2(out / "prove" / "prove.md", folder / "proof.md")
        shutil.copy2(out / "prove" / "prove.json", folder / "proof.json")
        if (out / "prove" / "figures").is_dir():
            shutil.copytree(out / "prove" / "figures", folder / "figures")
        (folder / REPORT).write_text(report_text(ledger.steps, request.tuned), encoding="utf-8")
