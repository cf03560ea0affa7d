"""Transitions of the lifecycle say why they fail, which rclpy does not."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Protocol, TypeVar

from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn


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
