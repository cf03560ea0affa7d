"""ROS parameters of the schema: declaration, types, ranges, and changes at run time."""

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
from test_node_parts import StubNode

from diffdrive_mpc.models.checked_yaml import ConfigError, check
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.ros.node import TrackingNode
from diffdrive_mpc.mpc.ros.parameters import declare, descriptor, fields, read
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from refusals import one_line_error

FIELDS = dict(fields(ControllerConfig)) | dict(fields(NodeSettings))


def set_over_dds(s, **values):
    message = [Parameter(name.replace("__", "."), value=value).to_parameter_msg() for name, value in values.items()]
    request = SetParametersAtomically.Request(parameters=message)
    return s.call(SetParametersAtomically, "/diffdrive_mpc/set_parameters_atomically", request).result


@pytest.mark.parametrize("schema", [ControllerConfig, NodeSettings])
def test_declared_parameters_are_read_back(schema):
    store, instance = StubNode(), schema()
    declare(store, instance)
    assert set(store.known) == {name for name, _ in fields(schema)}
    assert read(store, schema) == instance


@given(st.sampled_from(sorted(FIELDS)), st.floats(-1e3, 1e3) | st.integers(-1000, 1000).map(float))
def test_ranges_agree_with_the_schema(name, value):
    """The schema also refuses numbers outside the range of the descriptor."""
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
        names = s.call(ListParameters, "/diffdrive_mpc/list_parameters", ListParameters.Request()).result.names
        assert set(FIELDS) <= set(names)
        request = DescribeParameters.Request(names=sorted(FIELDS))
        descriptors = s.call(DescribeParameters, "/diffdrive_mpc/describe_parameters", request).descriptors
        for result, name in zip(descriptors, sorted(FIELDS), strict=True):
            assert result.name == name
            assert result.description == FIELDS[name].description
            assert result.type != ParameterType.PARAMETER_NOT_SET
            is_number = result.type in (ParameterType.PARAMETER_DOUBLE, ParameterType.PARAMETER_INTEGER)
            assert is_number == bool(result.floating_point_range or result.integer_range), name
        horizon = descriptors[sorted(FIELDS).index("horizon")].integer_range[0]
        assert (horizon.from_value, horizon.to_value) == (1, 200)
        progress = descriptors[sorted(FIELDS).index("expert.reentry.max_progress")]
        assert (progress.floating_point_range[0].from_value, progress.floating_point_range[0].to_value) == (1.0, 2.0)
        assert progress.additional_constraints == "greater than 1"


def test_configuration_file_defines_the_defaults(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("model: ssm\nhorizon: 25\nweights: {across: 321.0}\n")
    with stack(config=file, autostart=False) as s:
        assert s.node.get_parameter("weights.across").value == 321.0
        assert s.node.get_parameter("horizon").value == 25
        assert not set_over_dds(s, config="ssm").successful


@contextmanager
def started_node(*assignments):
    """Yield an unconfigured node with the parameters `name:=value`."""
    context = Context()
    rclpy.init(
        context=context, args=["--ros-args", *(option for assignment in assignments for option in ("-p", assignment))]
    )
    node = None
    try:
        node = TrackingNode(context=context)
        yield node
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("weights.acros:=20.0", "unknown parameter 'weights.acros'; did you mean 'weights.across'?"),
        ("across:=20.0", "unknown parameter 'across'; did you mean 'weights.across'?"),
        ("trajectry:=circle", "unknown parameter 'trajectry'; did you mean 'trajectory'?"),
        ("limits.gadget:=true", "unknown parameter 'limits.gadget'; "),
        ("expert.reentry.heading_wait:=9.0", "is the constant reentry.heading_wait"),
        ("online_dead_time.enabled:=false", "online_dead_time.enabled was removed: the filter estimates unknown"),
        ("expert.online_dead_time.apply:=true", "online_dead_time.apply was removed: the filter estimates unknown"),
        ("estimator.crab:=[0.1, 0.0, 0.0]", "set expert.estimator.crab in the file"),
    ],
)
def test_unknown_parameter_prevents_the_start(assignment, message):
    with one_line_error(ConfigError, message), started_node(assignment):
        pass


def test_parameter_of_another_node_gives_a_warning(capfd):
    with started_node("gadget:=true"):
        assert "without effect: unknown parameter 'gadget'; docs/parameters.md lists" in capfd.readouterr().err


def test_ros_parameters_and_former_constants_are_accepted(capfd):
    assignments = (
        "qos_overrides./clock.subscription.depth:=3",
        "use_sim_time:=true",
        "expert.reentry.heading_wait:=0.3",
    )
    with started_node(
        *assignments, "start_type_description_service:=false", "fence.x:=1.0", "fence.enabled:=false"
    ) as node:
        assert node.get_parameter("use_sim_time").value is True
    assert "without effect while fence.enabled is false: fence.x" in capfd.readouterr().err


def test_integer_is_converted_to_float():
    with started_node("weights.across:=20", "odom_timeout:=1", "limits.min_turn_radius:=1", "horizon:=12") as node:
        values = [node.get_parameter(name).value for name in ("weights.across", "odom_timeout", "horizon")]
        assert values == [20.0, 1.0, 12]
        assert [type(value) for value in values] == [float, float, int]
        changes = [Parameter("weights.across", value=30), Parameter("horizon", value=15)]
        assert node.set_parameters_atomically(changes).successful
        assert type(node.get_parameter("weights.across").value) is float
        assert node.get_parameter("weights.across").value == 30.0
        assert not node.set_parameters_atomically([Parameter("horizon", value=15.0)]).successful
        assert not node.set_parameters_atomically([Parameter("weights.across", value=-3)]).successful


def test_error_for_unknown_parameter_at_run_time_contains_its_name():
    with stack(autostart=False) as s:
        result = set_over_dds(s, weights__acros=20.0)
        assert not result.successful
        assert result.reason == "unknown parameter 'weights.acros'; did you mean 'weights.across'?"
        assert set_over_dds(s, weights__across=40).successful
        assert s.node.get_parameter("weights.across").value == 40.0
