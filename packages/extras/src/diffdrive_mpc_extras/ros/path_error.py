"""Part of the node that predicts errors: for the limit of paths of `follow_path`, and for `~/predict_error`.

A prediction takes about a millisecond for a path of a minute, and some seconds of simulated drives for the robot's own
plant, so the side process makes it.
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
from diffdrive_mpc.mpc.trajectories.planned.lay import PlannedPath
from diffdrive_mpc_extras.campaign.own_plant import own_plant
from diffdrive_mpc_extras.predicted_error.calibration import ErrorCalibration, load_calibration
from diffdrive_mpc_extras.predicted_error.drives import predict_reference
from diffdrive_mpc_extras.predicted_error.predicted_error import ErrorTube, PredictedError, check_origin, predict_tubes

OWN = "own"
"""Population of the plant that belongs to the configuration."""
_DRAWS = 20
"""Simulated drives of that plant: the fewest for 95 %, as the side process serves others, too."""
_SLOWER = (0.8, 0.6, 0.4, 0.2)
"""Shares of speed and acceleration at which a path is tried that has too wide a tube at full speed [-]."""


class PredictedErrorSettings(PartSettings):
    """Predicted errors, and the limit of them for paths of `follow_path`."""

    follow_error_limit: NotNegative = Field(
        0.0,
        description="a path is slowed or refused if its predicted lateral tube, of the share of drives that the "
        "calibration states (95 % as shipped), is wider than this; 0: never [m]",
    )
    follow_error_response: Literal["slow", "refuse"] = Field(
        "slow",
        description="slow: such a path is driven slower, and refused if a fifth of its speed is still too fast; "
        "refuse: it is refused [-]",
    )
    error_population: str = Field(
        "drawn", min_length=1, description="population of the calibration; own: drives of the own plant, no limit [-]"
    )
    error_calibration: str = Field("", description="calibration file of predicted errors; empty: the shipped one [-]")


@dataclass(frozen=True)
class ErrorPredictor:
    """Predicts errors of references for the model of a controller; it can be sent to the side process.

    Attributes
    ----------
    lag
        (2,) of the model [s].
    population
        Population of drives; `calibration` has it.
    calibration
        Coefficients and quantiles.
    plant
        Plant of `OWN`.
    """

    lag: FloatArray
    population: str
    calibration: ErrorCalibration
    plant: str = ""

    @classmethod
    def build(cls, controller: Controller, settings: PredictedErrorSettings, config: str = "") -> ErrorPredictor:
        """Read the calibration; ConfigError or ValueError where it cannot be used, or is for another model.

        `config` is the name or path of the configuration, in whose folder the plant of `OWN` is.
        """
        calibration = load_calibration(settings.error_calibration or None)
        is_own = settings.error_population == OWN
        if is_own and settings.follow_error_limit:
            raise ConfigError(f"error_population: {OWN} takes seconds; with follow_error_limit give a population")
        if not is_own:
            calibration.population(settings.error_population)
        check_origin(controller.model)
        return cls(controller.model.lag, settings.error_population, calibration, own_plant(config) if is_own else "")

    def predict(self, reference: Reference, config: ControllerConfig) -> PredictedError:
        """Predict the error; raise ValueError for a reference of no duration or over two hours, or of lost drives."""
        if self.population == OWN:
            return predict_reference(reference, config, self.plant, _DRAWS)
        return predict_tubes(reference, config, self.lag, self.population, self.calibration)

    def summary(self, reference: Reference, config: ControllerConfig) -> str:
        """Summarise the prediction in one line of JSON, see `_summary`."""
        return json.dumps(_summary(self.predict(reference, config), self.population))


def _summary(predicted: PredictedError, population: str) -> dict[str, object]:
    """Describe the widest place of both tubes: half width [m], time [s], distance [m], reasons, warnings."""

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
    """Condition on paths: the predicted error keeps to `follow_error_limit`; see `PathCheck`."""

    predictor: ErrorPredictor
    settings: PredictedErrorSettings

    def lay(
        self, lay: Callable[..., PlannedPath], config: ControllerConfig, speed: float, limits: TrajectoryLimits
    ) -> PlannedPath:
        """Lay a path whose predicted error keeps to the limit, slower if the settings allow that.

        A reference that began below the present `speed` [m/s] of the robot would pull it back: a moving robot is
        slowed no further than that, and otherwise refused, so that it stands when the next path comes.

        Raises
        ------
        ConfigError
            If no allowed speed observes the limit, with the excess and its place.
        """
        limit = self.settings.follow_error_limit
        slower = _SLOWER if self.settings.follow_error_response == "slow" else ()
        shares = (1.0, *(share for share in slower if share * limits.v >= speed))
        complaints = []
        for share in shares:
            laid = lay(_slowed(limits, share))
            try:
                complaint = _complaint(self.predictor.predict(laid.reference, config), limit)
            except ValueError as error:
                raise ConfigError(f"path: follow_error_limit cannot be checked: {error}") from error
            if not complaint:
                slowed = f"driven at {100 * share:g} % of its speed for follow_error_limit" if share < 1.0 else ""
                return replace(laid, note=slowed)
            complaints.append(complaint)
        slowest = f"; at {100 * shares[-1]:g} % of this speed: {complaints[-1]}" if complaints[1:] else ""
        raise ConfigError(
            f"path: {complaints[0]}{slowest}. Plan an easier path, lower follow_speed_share, or raise "
            "follow_error_limit"
        )


def _complaint(predicted: PredictedError, limit: float) -> str:
    """Describe why a path may exceed the limit [m]; empty if it does not."""
    width = float(predicted.lateral.everywhere.max())
    if width > limit:
        return (
            f"its predicted error is {1e3 * width:.1f} mm, follow_error_limit is {1e3 * limit:.1f} mm "
            f"({predicted.widest('lateral').sentence})"
        )
    return predicted.warnings[0] if predicted.warnings else ""


def _slowed(limits: TrajectoryLimits, share: float) -> TrajectoryLimits:
    names = ("v", "omega", "v_acceleration", "omega_acceleration")
    return replace(limits, **{name: share * getattr(limits, name) for name in names})


class PredictedErrorPart(NodePart):
    """Service `~/predict_error`, and the limit of the predicted error of paths."""

    schema = PredictedErrorSettings

    def __init__(self, node: PartHost) -> None:
        super().__init__(node)
        self._settings = PredictedErrorSettings()
        self._predictor: ErrorPredictor | None = None
        self._unpredictable = ""
        self._pending: set[Future] = set()
        # The reentrant group lets ticks continue while the service awaits the side process.
        group = ReentrantCallbackGroup()
        node.create_service(Trigger, "~/predict_error", self._predict, callback_group=group)

    def configure(self, tools: NodeTools) -> None:
        """Load the calibration; without a limit, a model without a prediction is accepted."""
        settings = self._settings = tools.part_settings(PredictedErrorSettings)
        self._predictor, self._unpredictable = None, ""
        try:
            self._predictor = ErrorPredictor.build(tools.controller, settings, tools.settings.config)
        except ConfigError:
            raise
        except ValueError as error:
            if settings.follow_error_limit:
                raise RefusedError(f"follow_error_limit is set, and {error}") from error
            self._unpredictable = str(error)

    def tear_down(self) -> None:
        """Answer the pending requests."""
        for future in self._pending:
            future.set_result((False, "the node was deactivated and cleaned up"))

    def path_check(self) -> PathCheck | None:
        """Return the limit of the predicted error."""
        if self._predictor is None or not self._settings.follow_error_limit:
            return None
        return ErrorLimit(self._predictor, self._settings)

    async def _predict(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Predict the error of the present reference in the side process."""
        try:
            loop, tools = self.running()
            if self._predictor is None:
                raise RefusedError(self._unpredictable)
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
            lambda words: future.set_result((True, words)),
            lambda why: future.set_result((False, why)),
        )
        response.success, response.message = await future
        self._pending.discard(future)
        return response
