"""The schema as ROS parameters: all of it, with type, text and range; changes are judged before and applied after."""

import sys
from contextlib import contextmanager

import pytest
import rclpy
from hypothesis import given
from hypothesis import strategies as st
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import DescribeParameters, ListParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.parameter import Parameter
from ros_parts import stack

from diffdrive_mpc.models.checked_yaml import ConfigError, check
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.ros.node import TrackingNode
from diffdrive_mpc.mpc.ros.parameters import declare, descriptor, fields, read
from diffdrive_mpc.mpc.ros.settings import NodeSettings

FIELDS = dict(fields(ControllerConfig)) | dict(fields(NodeSettings))


def set_over_dds(s, **values):
    message = [Parameter(name.replace("__", "."), value=value).to_parameter_msg() for name, value in values.items()]
    request = SetParametersAtomically.Request(parameters=message)
    return s.call(SetParametersAtomically, "/diffdrive_mpc/set_parameters_atomically", request).result


class Shelf:
    """Holds declared parameters, as a node does."""

    def __init__(self):
        self.held = {}

    def declare_parameters(self, _, parameters):
        self.held |= {name: Parameter(name, value=value) for name, value, _ in parameters}

    def get_parameter(self, name):
        return self.held[name]


@pytest.mark.parametrize("schema", [ControllerConfig, NodeSettings])
def test_declared_parameters_are_read_back(schema):
    shelf, instance = Shelf(), schema()
    declare(shelf, instance)
    assert set(shelf.held) == {name for name, _ in fields(schema)}
    assert read(shelf, schema) == instance


@given(st.sampled_from(sorted(FIELDS)), st.floats(-1e3, 1e3) | st.integers(-1000, 1000).map(float))
def test_ranges_agree_with_the_schema(name, value):
    """A number that the range of the descriptor excludes is refused by the schema too."""
    result = descriptor(FIELDS[name])
    for bounds in [*result.floating_point_range, *result.integer_range]:
        number = int(value) if result.integer_range else value
        if not bounds.from_value <= number <= bounds.to_value and bounds.to_value < sys.float_info.max:
            *groups, key = name.split(".")
            data = {key: number}
            for group in reversed(groups):
                data = {group: data}
            with pytest.raises(ConfigError):
                check(NodeSettings if name in NodeSettings.model_fields else ControllerConfig, data, "here")


def test_every_field_is_a_parameter_with_type_text_and_range():
    with stack(autostart=False) as s:
        listed = s.call(ListParameters, "/diffdrive_mpc/list_parameters", ListParameters.Request()).result.names
        assert set(FIELDS) <= set(listed)
        request = DescribeParameters.Request(names=sorted(FIELDS))
        described = s.call(DescribeParameters, "/diffdrive_mpc/describe_parameters", request).descriptors
        for result, name in zip(described, sorted(FIELDS), strict=True):
            assert result.name == name
            assert result.description == FIELDS[name].description
            assert result.type != ParameterType.PARAMETER_NOT_SET
            numbers = result.type in (ParameterType.PARAMETER_DOUBLE, ParameterType.PARAMETER_INTEGER)
            assert numbers == bool(result.floating_point_range or result.integer_range), name
        horizon = described[sorted(FIELDS).index("horizon")].integer_range[0]
        assert (horizon.from_value, horizon.to_value) == (1, 200)
        progress = described[sorted(FIELDS).index("expert.reentry.max_progress")]
        assert (progress.floating_point_range[0].from_value, progress.floating_point_range[0].to_value) == (1.0, 2.0)
        assert progress.additional_constraints == "greater than 1"


def test_configuration_file_gives_the_defaults(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("model: ssm\nhorizon: 25\nweights: {across: 321.0}\n")
    with stack(config=file, autostart=False) as s:
        assert s.node.get_parameter("weights.across").value == 321.0
        assert s.node.get_parameter("horizon").value == 25
        assert not set_over_dds(s, config="ssm").successful


@contextmanager
def started_with(*words):
    """Yield a node with these parameters; it is not configured."""
    context = Context()
    rclpy.init(context=context, args=["--ros-args", *(word for pair in words for word in ("-p", pair))])
    node = None
    try:
        node = TrackingNode(context=context)
        yield node
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("weights.acros:=20.0", "unknown parameter 'weights.acros'; did you mean 'weights.across'?"),
        ("across:=20.0", "unknown parameter 'across'; did you mean 'weights.across'?"),
        ("trajectry:=circle", "unknown parameter 'trajectry'; did you mean 'trajectory'?"),
        ("limits.gadget:=true", "unknown parameter 'limits.gadget'; "),
        ("expert.reentry.heading_wait:=9.0", "is the constant reentry.heading_wait"),
        (
            "online_dead_time.enabled:=false",
            "online_dead_time.enabled was removed: the filter estimates unknown delays",
        ),
        (
            "expert.online_dead_time.apply:=true",
            "online_dead_time.apply was removed: the filter estimates unknown delays",
        ),
        ("estimator.crab:=[0.1, 0.0, 0.0]", "set expert.estimator.crab in the file"),
    ],
)
def test_unknown_parameter_refuses_the_start_and_is_named(word, message):
    with pytest.raises(ConfigError) as refusal, started_with(word):
        pass
    assert message in str(refusal.value) and "\n" not in str(refusal.value)


def test_parameter_of_another_node_is_warned_of(capfd):
    with started_with("gadget:=true"):
        assert "without effect: unknown parameter 'gadget'; docs/parameters.md lists" in capfd.readouterr().err


def test_parameters_that_ros_declares_or_that_were_constants_are_accepted(capfd):
    words = ("qos_overrides./clock.subscription.depth:=3", "use_sim_time:=true", "expert.reentry.heading_wait:=0.3")
    with started_with(*words, "start_type_description_service:=false", "fence.x:=1.0", "fence.enabled:=false") as node:
        assert node.get_parameter("use_sim_time").value is True
    assert "without effect while fence.enabled is false: fence.x" in capfd.readouterr().err


def test_integer_is_taken_for_a_real_parameter():
    with started_with("weights.across:=20", "odom_timeout:=1", "limits.min_turn_radius:=1", "horizon:=12") as node:
        values = [node.get_parameter(name).value for name in ("weights.across", "odom_timeout", "horizon")]
        assert values == [20.0, 1.0, 12]
        assert [type(value) for value in values] == [float, float, int]
        changes = [Parameter("weights.across", value=30), Parameter("horizon", value=15)]
        assert node.set_parameters_atomically(changes).successful
        assert type(node.get_parameter("weights.across").value) is float
        assert node.get_parameter("weights.across").value == 30.0
        assert not node.set_parameters_atomically([Parameter("horizon", value=15.0)]).successful
        assert not node.set_parameters_atomically([Parameter("weights.across", value=-3)]).successful


def test_parameter_set_while_running_is_named_if_it_is_unknown():
    with stack(autostart=False) as s:
        result = set_over_dds(s, weights__acros=20.0)
        assert not result.successful
        assert result.reason == "unknown parameter 'weights.acros'; did you mean 'weights.across'?"
        assert set_over_dds(s, weights__across=40).successful
        assert s.node.get_parameter("weights.across").value == 40.0
