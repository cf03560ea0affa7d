"""Node part that predicts tracking errors, for the error limit of `follow_path` and the service `~/predict_error`.

A prediction takes about a millisecond for a path of one minute, but some seconds if it simulates drives of the robot's
own plant. It therefore runs in the side process.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from pydantic import Field
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from std_srvs.srv import Trigger

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc.mpc.ros.control_loop import RefusedError
from diffdrive_mpc.mpc.ros.node_part import NodePart, NodeTools, PartHost, PathCheck
from diffdrive_mpc.mpc.ros.settings import NotNegative, PartSettings
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.planned.planned_path import PlannedPath
from diffdrive_mpc_extras.campaign.own_plant import own_plant
from diffdrive_mpc_extras.predicted_error.calibration import ErrorCalibration, load_calibration
from diffdrive_mpc_extras.predicted_error.drives import predict_reference
from diffdrive_mpc_extras.predicted_error.predicted_error import ErrorTube, PredictedError, check_origin, predict_tubes

OWN = "own"
"""Population of simulated drives with the plant of the configuration."""
_DRAWS = 20
"""Number of simulated drives of that plant: the minimum for 95 %, because the side process has other jobs as well."""
_SPEED_SHARES = (0.8, 0.6, 0.4, 0.2)
"""Shares of speed and acceleration that are tried for a path that exceeds the limit at full speed [-]."""


class PredictedErrorSettings(PartSettings):
    """Settings of predicted errors, and their limit for paths of `follow_path`."""

    follow_error_limit: NotNegative = Field(
        0.0,
        description="limit of the half width of a path's predicted lateral tube, for the share of drives that the "
        "calibration states (95 % as shipped); a path above it is slowed or refused; 0: no limit [m]",
    )
    follow_error_response: Literal["slow", "refuse"] = Field(
        "slow",
        description="response to a path above follow_error_limit; slow: drive slower, and refuse the path if a fifth "
        "of its speed is still too fast; refuse: refuse the path [-]",
    )
    error_population: str = Field(
        "drawn",
        min_length=1,
        description="population of the calibration; own: simulated drives of the robot's plant, without limit [-]",
    )
    error_calibration: str = Field("", description="calibration file of predicted errors; empty: the shipped one [-]")


@dataclass(frozen=True)
class ErrorPredictor:
    """Predictor of tracking errors for the model of a controller; it can be pickled for the side process.

    Attributes
    ----------
    lag
        (2,) lags of the model [s].
    population
        Population of `calibration`, or `OWN`.
    calibration
        Coefficients and quantiles.
    plant
        Plant of the population `OWN`, else empty.
    """

    lag: FloatArray
    population: str
    calibration: ErrorCalibration
    plant: str = ""

    @classmethod
    def build(cls, controller: Controller, settings: PredictedErrorSettings, config: str = "") -> ErrorPredictor:
        """Load the calibration and build the predictor.

        `config` is the name or path of the configuration; its folder contains the plant of `OWN`. Raises ConfigError
        for invalid settings or calibrations, and ValueError for a model without a prediction.
        """
        calibration = load_calibration(settings.error_calibration or None)
        is_own = settings.error_population == OWN
        if is_own and settings.follow_error_limit:
            raise ConfigError(f"error_population: {OWN} takes seconds; use another population with follow_error_limit")
        if not is_own:
            calibration.population(settings.error_population)
        check_origin(controller.model)
        return cls(controller.model.lag, settings.error_population, calibration, own_plant(config) if is_own else "")

    def predict(self, reference: Reference, config: ControllerConfig) -> PredictedError:
        """Predict the error; raises ValueError for a duration of zero or over two hours, or if a drive is lost."""
        if self.population == OWN:
            return predict_reference(reference, config, self.plant, _DRAWS)
        return predict_tubes(reference, config, self.lag, self.population, self.calibration)

    def summary(self, reference: Reference, config: ControllerConfig) -> str:
        """Return the prediction as one line of JSON, see `_summary`."""
        return json.dumps(_summary(self.predict(reference, config), self.population))


def _summary(predicted: PredictedError, population: str) -> dict[str, object]:
    """Return the widest point of both tubes: half width [m], time [s], arc length [m], description, and warnings."""

    def widest(tube: ErrorTube, words: str, index: int) -> dict[str, object]:
        return {
            "at_each_place": round(float(tube.at_each_place[index]), 5),
            "everywhere": round(float(tube.everywhere[index]), 5),
            "time": round(float(predicted.time[index]), 3),
            "arc_length": round(float(predicted.arc_length[index]), 3),
            "words": words,
        }

    lateral, along = predicted.widest("lateral"), predicted.widest("along")
    return {
        "reference": predicted.reference,
        "level": predicted.level,
        "population": population,
        "lateral": widest(predicted.lateral, lateral.sentence, lateral.index),
        "along": widest(predicted.along, along.sentence, along.index),
        "warnings": list(predicted.warnings),
    }


@dataclass(frozen=True)
class ErrorLimit:
    """Check of paths against `follow_error_limit`; see `PathCheck`."""

    predictor: ErrorPredictor
    settings: PredictedErrorSettings

    def plan(
        self, plan: Callable[..., PlannedPath], config: ControllerConfig, speed: float, limits: TrajectoryLimits
    ) -> PlannedPath:
        """Plan a path with a predicted error within the limit, at reduced speed if the settings allow that.

        The reduced speed is not below the current `speed` [m/s] of the robot, because the reference would fall behind
        the robot at its start.

        Raises
        ------
        ConfigError
            If the path exceeds the limit at every allowed speed; the message states the excess and its place.
        """
        limit = self.settings.follow_error_limit
        reduced = _SPEED_SHARES if self.settings.follow_error_response == "slow" else ()
        shares = (1.0, *(share for share in reduced if share * limits.v >= speed))
        reasons = []
        for share in shares:
            path = plan(_scale_limits(limits, share))
            try:
                reason = _reason_to_refuse(self.predictor.predict(path.reference, config), limit)
            except ValueError as error:
                raise ConfigError(f"path: follow_error_limit cannot be checked: {error}") from error
            if not reason:
                note = f"driven at {100 * share:g} % of its speed for follow_error_limit" if share < 1.0 else ""
                return replace(path, note=note)
            reasons.append(reason)
        slowest = f"; at {100 * shares[-1]:g} % of this speed: {reasons[-1]}" if reasons[1:] else ""
        raise ConfigError(
            f"path: {reasons[0]}{slowest}. Plan an easier path, lower follow_speed_share, or raise follow_error_limit"
        )


def _reason_to_refuse(predicted: PredictedError, limit: float) -> str:
    """Describe why a path may exceed the limit [m]; empty within the limit."""
    width = float(predicted.lateral.everywhere.max())
    if width > limit:
        return (
            f"its predicted error is {1e3 * width:.1f} mm, follow_error_limit is {1e3 * limit:.1f} mm "
            f"({predicted.widest('lateral').sentence})"
        )
    return predicted.warnings[0] if predicted.warnings else ""


def _scale_limits(limits: TrajectoryLimits, share: float) -> TrajectoryLimits:
    names = ("v", "omega", "v_acceleration", "omega_acceleration")
    return replace(limits, **{name: share * getattr(limits, name) for name in names})


class PredictedErrorPart(NodePart):
    """Node part with the service `~/predict_error` and the error limit of paths."""

    schema = PredictedErrorSettings

    def __init__(self, node: PartHost) -> None:
        super().__init__(node)
        self._settings = PredictedErrorSettings()
        self._predictor: ErrorPredictor | None = None
        self._missing_reason = ""
        self._pending: set[Future] = set()
        # With a reentrant group, ticks continue while the service awaits the side process.
        group = ReentrantCallbackGroup()
        node.create_service(Trigger, "~/predict_error", self._predict, callback_group=group)

    def configure(self, tools: NodeTools) -> None:
        """Load the calibration; a model without a prediction is accepted if no limit is set."""
        settings = self._settings = tools.part_settings(PredictedErrorSettings)
        self._predictor, self._missing_reason = None, ""
        try:
            self._predictor = ErrorPredictor.build(tools.controller, settings, tools.settings.config)
        except ConfigError:
            raise
        except ValueError as error:
            if settings.follow_error_limit:
                raise RefusedError(f"follow_error_limit is set, and {error}") from error
            self._missing_reason = str(error)

    def tear_down(self) -> None:
        """Answer the pending requests."""
        for future in self._pending:
            future.set_result((False, "the node was deactivated and cleaned up"))

    def path_check(self) -> PathCheck | None:
        """Return the check of the error limit; None without a limit."""
        if self._predictor is None or not self._settings.follow_error_limit:
            return None
        return ErrorLimit(self._predictor, self._settings)

    async def _predict(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Predict the error of the current reference in the side process."""
        try:
            loop, tools = self.require_active()
            if self._predictor is None:
                raise RefusedError(self._missing_reason)
            if loop.reference is None:
                raise RefusedError("there is no reference yet; send one, or set the parameter trajectory")
        except ValueError as error:
            response.success, response.message = False, str(error)
            return response
        future = Future()
        self._pending.add(future)
        tools.side_process.submit(
            "predict_error",
            ErrorPredictor.summary,
            (self._predictor, loop.reference, tools.controller.config),
            lambda summary: future.set_result((True, summary)),
            lambda reason: future.set_result((False, reason)),
        )
        response.success, response.message = await future
        self._pending.discard(future)
        return response
