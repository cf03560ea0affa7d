"""The schema as ROS parameters: all of it, with type, text and range; changes are judged before and applied after."""

import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lifecycle_msgs.msg import Transition
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import DescribeParameters, ListParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from ros_parts import CONFIG, stack

from diffdrive_mpc.models.checked_yaml import ConfigError, check
from diffdrive_mpc.mpc.config.schema import ControllerConfig
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
    found = descriptor(FIELDS[name])
    for bounds in [*found.floating_point_range, *found.integer_range]:
        number = int(value) if found.integer_range else value
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
        for found, name in zip(described, sorted(FIELDS), strict=True):
            assert found.name == name
            assert found.description == FIELDS[name].description
            assert found.type != ParameterType.PARAMETER_NOT_SET
            numbers = found.type in (ParameterType.PARAMETER_DOUBLE, ParameterType.PARAMETER_INTEGER)
            assert numbers == bool(found.floating_point_range or found.integer_range), name
        horizon = described[sorted(FIELDS).index("horizon")].integer_range[0]
        assert (horizon.from_value, horizon.to_value) == (1, 200)
        progress = described[sorted(FIELDS).index("expert.reentry.max_progress")]
        assert (progress.floating_point_range[0].from_value, progress.floating_point_range[0].to_value) == (1.0, 2.0)
        assert progress.additional_constraints == "greater than 1"


def test_weights_and_limits_change_between_two_ticks():
    with stack(drive=True) as s:
        s.base.run(40)
        assert set_over_dds(s, limits__v=0.3, weights__across=300.0).successful
        assert s.node._controller.config.limits.v == CONFIG.limits.v
        s.base.run(1)
        assert s.node._controller.config.limits.v == 0.3
        assert s.node._controller.config.weights.across == 300.0
        slower = s.base.run(60)
        assert slower[-1, 0] <= 0.3
        steps = abs(slower[1:, 0] - slower[:-1, 0])
        assert (steps <= CONFIG.limits.v_slew * CONFIG.sample_time + 1e-9).all()


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"weights__across": -1.0}, "weights.across"),
        ({"horizon": 20}, "horizon cannot change while the node is active"),
        ({"weights__across": 200.0, "horizon": 20}, "horizon cannot change"),
        ({"use_sim_time": False}, "use_sim_time cannot change"),
    ],
)
def test_rejected_change_while_driving_reports_its_reason(values, reason):
    with stack(drive=True) as s:
        s.base.run(5)
        result = set_over_dds(s, **values)
        assert not result.successful
        assert reason in result.reason
        s.base.run(2)
        assert s.node._controller.config == CONFIG


def test_structural_changes_while_inactive_act_on_activation():
    with stack() as s:
        assert s.change(Transition.TRANSITION_DEACTIVATE)
        refused = set_over_dds(s, model="smm")
        assert not refused.successful
        assert "unknown model 'smm'" in refused.reason
        refused = set_over_dds(s, horizon=1, extra_dead_time__v=0.5)
        assert not refused.successful
        assert set_over_dds(s, model="sm", horizon=15, stamped=False).successful
        assert s.change(Transition.TRANSITION_ACTIVATE)
        assert s.node._controller.config.horizon == 15
        assert s.node._controller.model.structure == "sm"


def test_configuration_file_gives_the_defaults(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("model: ssm\nhorizon: 25\nweights: {across: 321.0}\n")
    with stack(config=file, autostart=False) as s:
        assert s.node.get_parameter("weights.across").value == 321.0
        assert s.node.get_parameter("horizon").value == 25
        assert not set_over_dds(s, config="ssm").successful
