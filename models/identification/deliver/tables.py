"""Tables of an identification report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.identification.effects import IdentifiedBase
from diffdrive_mpc.models.identification.fit.fitting import Fitted
from diffdrive_mpc.models.identification.fit.poses import PoseResults
from diffdrive_mpc.models.logs.record import Finding
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.structures.orders import OrderChoice
from diffdrive_mpc.models.table import TextTable, number
from diffdrive_mpc.models.velocity_model import CHANNELS


def score_table(fitted: Fitted) -> TextTable:
    """Tabulate FIT and RMSE of the simulation from commands."""
    train, validation = fitted.train, fitted.validation
    rows = [
        (
            channel,
            number(float(train.fit_percent[i]), 2),
            number(float(validation.fit_percent[i]), 2),
            number(float(train.rmse[i])),
            number(float(validation.rmse[i])),
        )
        for i, channel in enumerate(CHANNELS)
    ]
    columns = ("channel", "FIT training [%]", "FIT validation [%]", "RMSE training", "RMSE validation")
    note = "Simulation from commands only, started once in each record; RMSE in m/s and rad/s."
    return TextTable("Scores of the model", columns, tuple(rows), note=note)


def residual_table(fitted: Fitted) -> TextTable:
    """Tabulate whiteness of the validation residuals, and their correlation with past commands."""
    check = fitted.validation.residuals
    rows = [
        (channel, f"{check.ljung_box_p[i]:.2g}", *(number(float(x), 2) for x in check.unexplained[i]))
        for i, channel in enumerate(CHANNELS)
    ]
    columns = ("residual of", "p if white [-]", "with past v_ref [bounds]", "with past omega_ref [bounds]")
    note = "Maximum correlation with a past command over its 95 % bound; values well above 1 indicate missing dynamics."
    return TextTable("Residuals on validation data", columns, tuple(rows), note=note)


def drift_table(poses: PoseResults) -> TextTable:
    """Tabulate the open-loop pose error."""
    rows = [
        (f"{d.horizon:g}", number(d.position_rmse), number(d.position_mean), number(d.heading_rmse), str(d.starts))
        for d in poses.drift
    ]
    columns = ("after [s]", "position RMSE [m]", "position mean [m]", "heading RMSE [rad]", "starts")
    note = "Poses predicted from commands only, compared with measured poses, on validation data."
    return TextTable("Open-loop pose error", columns, tuple(rows), text_columns=0, note=note)


def delay_table(delays: ParameterEstimate) -> TextTable:
    """Tabulate the delay of the robot: sum of dead time and lag, which a log determines well, and both terms."""
    cells = [f"{value:.3g} +- {deviation:.2g}" for _, value, deviation in delays.rows]
    names = dict.fromkeys(name.partition(".")[0] for name in delays.names)
    rows = [(name, *cells[3 * i : 3 * i + 3]) for i, name in enumerate(names)]
    note = "With standard deviations. Tracking depends on the sum; many divisions of the sum predict equally well."
    columns = ("response of", "dead time + lag [s]", "dead time [s]", "lag [s]")
    return TextTable("Delay of the robot", columns, tuple(rows), note=note)


def parameter_table(title: str, estimate: ParameterEstimate, *, dead_times: bool = True) -> TextTable:
    """Tabulate values with standard deviations; if `dead_times` is False, omit dead times (see `delay_table`)."""
    rows = [
        (name, f"{value:.5g}", f"{deviation:.2g}")
        for name, value, deviation in estimate.rows
        if dead_times or "dead_time" not in name
    ]
    note = "SI units: gains and damping [-], frequencies and poles [rad/s], times [s], lengths [m]."
    return TextTable(title, ("parameter", "value", "standard deviation"), tuple(rows), note=note)


def order_table(choice: OrderChoice) -> TextTable:
    """Tabulate the compared orders, as in Table 1 of Guffanti, Pavon, Sensors 2025, 25(18), 5821."""
    rows = []
    for order, row in enumerate(choice.rows, start=1):
        fits = (row.train_fit_percent, row.block_fit_percent, row.validation_fit_percent)
        cells = [number(float(x), 2) for fit in fits for x in (np.full(2, np.nan) if fit is None else fit)]
        mark = "selected" if order == choice.order else ""
        rows.append((f"{order}", mark, str(row.parameters), *cells, f"{row.aic:.0f}", f"{row.bic:.0f}"))
    columns = (
        *("order", "", "parameters", "FIT training v [%]", "omega [%]", "FIT blocks v [%]", "omega [%]"),
        *("FIT validation v [%]", "omega [%]", "AIC", "BIC"),
    )
    note = f"Order {choice.order}: {choice.reason}. AIC and BIC are relative to their minimum over all orders."
    return TextTable("Comparison of orders", columns, tuple(rows), text_columns=2, note=note)


def effect_table(base: IdentifiedBase) -> TextTable:
    """Tabulate the trials of effects in addition to the linear model, and mark the selected effects."""
    rows = [
        (
            trial.effect + (", second trial" if trial.again else ""),
            number(trial.gain),
            str(trial.blocks),
            "yes" if trial.selected else "no",
        )
        for trial in base.trials
    ]
    note = "Gain: decrease of the logarithm of the error power on held-out parts of the training data."
    return TextTable(
        "Effects of the base", ("effect", "gain [-]", "better in blocks", "in the model"), tuple(rows), note=note
    )


def finding_table(findings: Sequence[Finding]) -> TextTable:
    """Tabulate the findings in the logs."""
    rows = tuple(
        (finding.severity, finding.kind, finding.place, finding.message, str(finding.verdict or ""))
        for finding in findings
    )
    return TextTable(
        "Findings in the logs", ("severity", "kind", "place", "description", "for driving"), rows, text_columns=5
    )
