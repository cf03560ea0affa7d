"""Changes of parameters while the node runs: judged before, without side effects, and applied after."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc.mpc.ros.parameters import fields, read
from diffdrive_mpc.mpc.ros.settings import NodeSettings

_WHILE_DRIVING = ("weights.", "limits.")
_KNOWN = {name for schema in (NodeSettings, ControllerConfig) for name, _ in fields(schema)} | {"use_sim_time"}


class ParameterChanges:
    """Watches the declared parameters of a node; those of others pass.

    Parameters
    ----------
    node
        The node.
    running
        The controller that drives; None while the node is not active.
    fixed
        What of the controller's configuration is no parameter.
    changed
        Called when weights or limits of the controller that drives have changed.

    Attributes
    ----------
    pending
        Whether values have changed since this was last set to False.
    """

    def __init__(
        self,
        node: Node,
        running: Callable[[], Controller | None],
        fixed: Mapping[str, object] | None = None,
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        self._node, self._running, self._fixed, self._changed = node, running, fixed, changed
        self.pending = False
        node.add_on_set_parameters_callback(self._judge)
        node.add_post_set_parameters_callback(self._apply)

    def _judge(self, parameters: list[Parameter]) -> SetParametersResult:
        changes = _ours(parameters)
        fixed = [name for name, value in changes.items() if self._is_fixed_now(name, value)]
        if fixed:
            reason = f"{fixed[0]} cannot change while the node is active; pause, deactivate, set it, activate"
            return SetParametersResult(successful=False, reason=reason)
        try:
            read(self._node, NodeSettings, changes)
            config = read(self._node, ControllerConfig, changes, self._fixed)
            if any(not name.startswith(_WHILE_DRIVING) for name in changes):
                Controller(config)
            controller = self._running()
            if controller is not None:
                # What cannot be changed while driving would otherwise be known only when nobody can be told any more.
                controller.updated(*_groups(changes, config))
        except (ValueError, OSError) as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _is_fixed_now(self, name: str, value: object) -> bool:
        if self._running() is None or name.startswith(_WHILE_DRIVING):
            return False
        return bool(self._node.get_parameter(name).value != value)

    def _apply(self, parameters: list[Parameter]) -> None:
        """Between two ticks while active, else at the next activation."""
        changes = _ours(parameters)
        self.pending = self.pending or bool(changes)
        controller = self._running()
        if controller is not None and changes:
            controller.update(*_groups(changes, read(self._node, ControllerConfig, fixed=self._fixed)))
            self._changed()


def _ours(parameters: Iterable[Parameter]) -> dict[str, Any]:
    return {item.name: item.value for item in parameters if item.name in _KNOWN}


def _groups(changes: Mapping[str, Any], config: ControllerConfig) -> list[dict[str, float]]:
    """Changed weights and limits as `config` has them, in which what stands for None is None."""
    return [
        {
            name.removeprefix(prefix): getattr(getattr(config, prefix[:-1]), name.removeprefix(prefix))
            for name in changes
            if name.startswith(prefix)
        }
        for prefix in _WHILE_DRIVING
    ]
