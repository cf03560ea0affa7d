"""The layouts for Foxglove and PlotJuggler: everything that they name is in a file of a drive."""

import json
import re
from xml.etree import ElementTree

import pytest
from mcap.reader import make_reader

from commands import invoke
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.app.layouts import LAYOUTS, layout
from diffdrive_mpc.models.logs.drive_log.topics import STATE


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    """Topics of a logged run with the type of each, and every field of the rows that the file really holds."""
    log = tmp_path_factory.mktemp("layouts") / "s.mcap"
    words = ["simulate", "--plant", "model:ssm", "--trajectory", "s", "--log", str(log)]
    invoke(app, *words)
    topics, fields = {}, set()
    with log.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            topics[channel.topic] = schema.name
            if channel.topic == STATE:
                fields |= set(json.loads(message.data))
    return topics, fields


def named_by_foxglove(config):
    """Message paths and topics of one panel."""
    yield from (path["value"] for path in config.get("paths", ()))
    yield from config.get("topics", ())
    if "topicToRender" in config:
        yield config["topicToRender"]


def test_everything_that_foxglove_shows_is_in_a_file(paths):
    topics, fields = paths
    content = json.loads(layout("foxglove.json"))
    named = [path for config in content["configById"].values() for path in named_by_foxglove(config)]
    assert len(named) > 15
    for path in named:
        topic, _, field = path.partition(".")
        assert topic in topics, path
        assert not field or field in fields, path


def test_every_panel_of_foxglove_has_its_place(paths):
    content = json.loads(layout("foxglove.json"))

    def placed(node):
        return {node} if isinstance(node, str) else placed(node["first"]) | placed(node["second"])

    assert placed(content["layout"]) == set(content["configById"])
    kinds = {name.partition("!")[0] for name in content["configById"]}
    assert kinds == {"3D", "Plot", "StateTransitions", "DiagnosticSummary"}
    scene = next(config for name, config in content["configById"].items() if name.startswith("3D!"))
    shown = {paths[0][topic].rpartition("/")[2] for topic in scene["topics"]}
    assert shown <= {"Path", "PoseStamped", "PoseWithCovarianceStamped"}
    assert "/tf" in paths[0]


def test_every_curve_of_plotjuggler_is_in_a_file(paths):
    topics, fields = paths
    curves = list(ElementTree.fromstring(layout("plotjuggler.xml")).iter("curve"))
    assert len(curves) > 15
    names = [curve.get(name) for curve in curves for name in axes(curve)]
    for name in names:
        topic, _, field = name.rpartition("/")
        assert topic in topics and field in fields, name


def axes(curve):
    return ("curve_x", "curve_y") if curve.get("curve_x") else ("name",)


def test_each_quantity_has_one_name_in_both(paths):
    both = [set(re.findall(r"\w+_(?:m|m_s|rad_s|s)\b", layout(name))) for name in LAYOUTS]
    assert both[0] <= both[1]


def test_the_command_writes_them(tmp_path):
    invoke(app, "log", "layouts", "--out", tmp_path)
    assert {path.name: path.read_text(encoding="utf-8") for path in tmp_path.iterdir()} == {
        name: layout(name) for name in LAYOUTS
    }
