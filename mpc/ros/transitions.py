"""Transitions of the lifecycle say why they fail, and those that are not allowed are refused: rclpy does neither."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, Protocol, TypeVar

from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn


class Managed(Protocol):
    """A lifecycle node that keeps why its last failed transition failed."""

    failure: str

    def get_logger(self) -> RcutilsLogger:
        """Logger of the node."""
        ...


NodeType = TypeVar("NodeType", bound=Managed)
Transition = Callable[[NodeType, LifecycleState], TransitionCallbackReturn]


def logged(transition: Transition[NodeType]) -> Transition[NodeType]:
    """Log what a transition raises: bad input (ValueError, OSError) refuses it, anything else is an error."""

    @wraps(transition)
    def run(self: NodeType, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(self, state)
        except (ValueError, OSError) as error:
            self.failure = str(error)
            self.get_logger().error(self.failure)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self.failure = f"{type(error).__name__}: {error}"
            self.get_logger().fatal(self.failure)
            return TransitionCallbackReturn.ERROR

    return run


def refuse_what_is_not_allowed(node: LifecycleNode) -> None:
    """Let the service change_state of `node` answer no, with a warning, where rclpy ends the process.

    For a transition that its state does not have, rclpy raises inside the service's callback, and `spin` with it.
    """
    services = {service.srv_type: service for service in node.services}
    change = services[ChangeState].callback

    def answer(request: Any, response: Any) -> Any:  # noqa: ANN401 - ROS messages have no types to check
        wanted, state = request.transition, services[GetState].callback(None, GetState.Response()).current_state
        # Two services have this type: one has the transitions of this state, the other those of all states.
        known = services[GetAvailableTransitions].callback(None, GetAvailableTransitions.Response())
        allowed = [row.transition for row in known.available_transitions if row.start_state.id == state.id]
        # As rclpy: a label goes before the number.
        if any(wanted.label == each.label if wanted.label else wanted.id == each.id for each in allowed):
            return change(request, response)
        asked = f"'{wanted.label}'" if wanted.label else str(wanted.id)
        choice = ", ".join(f"{each.label} ({each.id})" for each in allowed) or "none"
        node.get_logger().warning(f"transition {asked} refused: the node is {state.label}; allowed: {choice}")
        response.success = False
        return response

    services[ChangeState].callback = answer
