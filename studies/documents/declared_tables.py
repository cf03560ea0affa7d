"""Tables of documents that are generated from declarations: parameters of the node, and scalars of a step.

`python -m studies.documents.declared_tables`, run in the root folder of the repository, writes both tables.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import chain
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import ConfigError, read_yaml
from diffdrive_mpc.models.plug_ins import plug_in, plug_in_names
from diffdrive_mpc.models.step_scalars import step_scalars
from diffdrive_mpc.models.two_sided import SIDES
from diffdrive_mpc.mpc.config.described import FieldRow, feature_rows, schema_rows
from diffdrive_mpc.mpc.config.rooms import EXPERT, plain_key
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from studies.documents.documents import insert

_ADVICE = Path(__file__).parent / "parameter_advice.yaml"
_HEAD = (
    "| parameter | unit | default | range | what it does | when to change it |\n| --- | --- | --- | --- | --- | --- |"
)
_TITLES = {
    "": "Controller",
    "extra_dead_time": "Dead time in addition to that of the model file",
    "weights": "Weights, also while driving",
    "margin": "Delay margin of the loop",
    "limits": "Limits, also while driving",
    "wheels": "Wheels",
    "sensors.wheels": "Measurements of the encoders",
    "sensors.yaw_rate": "Measurements of the gyroscope",
    "sensors.pose": "Measured poses",
    "solver": "Solver",
    "solver.osqp": "OSQP, if solver.method is osqp",
    "compensation": "Compensation",
    "estimator": "Estimator",
    "monitor": "Detection of contradictory sensors",
    "failure": "Failure",
    "fence": "Fence",
    "reentry": "Re-entry",
    "finish": "Finish",
    "energy": "Feature energy: costs of turns",
    "free_space": "Feature free_space: corridors and obstacles",
    "rehearsal": "Feature rehearsal: repetitions of a reference",
    "rehearsal.drivable": "Feature rehearsal: drivable path, for rehearsal by floor",
}


def parameter_tables() -> str:
    """Tabulate all parameters of the node by group, from the schemas and `parameter_advice.yaml`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a parameter has no entry in `parameter_advice.yaml`, or an entry is neither a parameter nor a group.
    """
    advice: dict[str, str] = read_yaml(_ADVICE)
    keys = [plain_key(row.key) for row in [*node_rows(), *chain(*part_rows().values()), *_controller_rows()]]
    names = {*keys, *(key.partition(".")[0] for key in keys)}
    for name in advice:
        if name not in names:
            raise ConfigError(f"{_ADVICE.name}: '{name}' is neither a parameter nor a group; remove the entry")
    groups: dict[str, list[FieldRow]] = {}
    for row in _controller_rows():
        *group, name = row.key.split(".")
        groups.setdefault(".".join(group[:-1] if name in SIDES else group), []).append(row)
    tables = [_table("The node", node_rows(), advice)]
    tables += [_table(f"Part {name} of the node", rows, advice) for name, rows in part_rows().items()]
    tables += [_table(_title(group), rows, advice) for group, rows in groups.items()]
    return "\n\n".join([*tables, _table("Lists, which are not parameters of the node", _list_rows(), advice)])


def node_rows() -> list[FieldRow]:
    """Return the parameters of the node, without the parameters of its parts."""
    return [row for row in schema_rows(NodeSettings) if row.key != "parts"]


def part_rows() -> dict[str, list[FieldRow]]:
    """Return the parameters of the installed parts of the node by name of the part."""
    return {
        name: schema_rows(plug_in("node_parts", name).schema, f"parts.{name}.") for name in plug_in_names("node_parts")
    }


def _title(group: str) -> str:
    """Return the title of the table of a group; titles of expert groups have a prefix."""
    title_key = group.removeprefix(EXPERT).removeprefix(".")
    return f"For experts: {_TITLES[title_key]}" if group != title_key else _TITLES[group]


def _controller_rows() -> list[FieldRow]:
    """Return the keys of the configuration and of installed features that are parameters of the node."""
    return [row for row in _schema_rows() if not row.default.startswith("[")]


def _list_rows() -> list[FieldRow]:
    """Return the keys whose values are lists, which can be set only in a file."""
    return [row for row in _schema_rows() if row.default.startswith("[")]


def _schema_rows() -> list[FieldRow]:
    rows = (*schema_rows(ControllerConfig), *feature_rows())
    return [row for row in rows if not row.key.startswith("terms")]


def with_tables(name: str, page: str) -> str:
    """Return the text `page` of the document `name` with its table updated."""
    marker, table = PAGES[name]
    return insert(page, table(), marker)


def _table(title: str, rows: list[FieldRow], advice: dict[str, str]) -> str:
    return "\n".join([f"## {title}\n", _HEAD, *(_line(row, advice) for row in rows)])


def _line(row: FieldRow, advice: dict[str, str]) -> str:
    key = plain_key(row.key)
    *_, name = key.split(".")
    row_advice = (
        advice.get(key)
        or (name in SIDES and "if the two sides of your robot differ")
        or advice.get(key.partition(".")[0])
    )
    if not row_advice:
        raise ConfigError(f"{_ADVICE.name}: no advice on '{row.key}'; add when to change it")
    # A ROS parameter cannot be null.
    default = "0 (none)" if row.default == "null" else row.default
    cells = (f"`{row.key}`", row.unit, default, row.range, row.help, row_advice)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def scalars_table() -> str:
    """Tabulate the declared scalars of a step as Markdown."""
    rows = [f"| `{name}` | {scalar.unit} | {scalar.help} |" for name, scalar in step_scalars().items()]
    return "\n".join(("| column | unit | meaning |", "| --- | --- | --- |", *rows))


PAGES: Mapping[str, tuple[str, Callable[[], str]]] = {
    "parameters.md": ("parameters", parameter_tables),
    "logs.md": ("scalars", scalars_table),
}
"""Marker of the table, and function that builds the table, by name of the document."""

if __name__ == "__main__":
    for name in PAGES:
        page = Path("docs") / name
        page.write_text(with_tables(name, page.read_text(encoding="utf-8")), encoding="utf-8")
