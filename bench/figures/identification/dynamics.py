"""What the model is: step responses, and its poles with their uncertainty."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.bench.identification.outcome import Outcome
from diffdrive_mpc.bench.identification.settings import report_settings
from diffdrive_mpc.models.identification.estimate import Estimate
from diffdrive_mpc.models.identification.identified import IdentifiedModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.velocity_model import CHANNELS

_SAMPLES = 400
_INTERVAL = 1.959964
_UNITS = {"v": "m/s", "omega": "rad/s"}


def draw_steps(outcome: Outcome, path: Path) -> None:
    """Draw the response of both outputs to a unit step of either command, dead time included."""
    model = outcome.fitted.identified.model
    horizon = report_settings().step_response * float(model.lag.max())
    discrete = model.discretise(horizon / _SAMPLES)
    time = discrete.dt * np.arange(_SAMPLES + 1)
    with new_figure(path, 7.4, 3.4) as figure:
        panels = figure.subplots(1, 2)
        for j, (axes, command) in enumerate(zip(panels, CHANNELS, strict=True)):
            response = discrete.simulate(np.tile(np.eye(2)[j], (len(time), 1)))
            axes.axhline(1.0, color=REFERENCE_COLOUR, linewidth=0.9, linestyle=":")
            for i, channel in enumerate(CHANNELS):
                label = f"{channel} [{_UNITS[channel]}], steady {model.dc_gain[i, j]:.3f}"
                axes.plot(time, response[:, i], color=colour(i), linestyle=line_style(i), label=label)
            axes.axvline(model.dead_time[j], color="black", linewidth=0.6)
            axes.set(xlabel="time [s]", title=f"step of {command}_ref by 1 {_UNITS[command]}")
            axes.legend(loc="center right")
        figure.suptitle(f"{outcome.name}: step responses; the upright line is the dead time")


def draw_poles(outcome: Outcome, path: Path) -> None:
    """Draw the poles, with 95 % intervals where the estimate states them."""
    identified = outcome.fitted.identified
    poles = identified.model.poles
    with new_figure(path, 5.6, 4.2) as figure:
        axes = figure.add_subplot()
        axes.axhline(0.0, color="black", linewidth=0.6)
        for real, imag, real_deviation, imag_deviation in _uncertain_poles(identified):
            for sign in (1.0, -1.0) if imag else (1.0,):
                axes.errorbar(
                    real,
                    sign * imag,
                    xerr=_INTERVAL * real_deviation,
                    yerr=_INTERVAL * imag_deviation if imag else None,
                    color=colour(1),
                    capsize=2.5,
                    linewidth=1.0,
                )
        axes.plot(poles.real, poles.imag, "x", color=colour(0), markersize=8, markeredgewidth=1.8)
        # An interval may reach to infinity; the poles set the scale.
        reach = 1.4 * float(np.abs(poles).max())
        height = max(reach / 3, 1.3 * float(np.abs(poles.imag).max()))
        axes.set(
            xlim=(-reach, 0.05 * reach),
            ylim=(-height, height),
            xlabel="real part [rad/s]",
            ylabel="imaginary part [rad/s]",
            title=f"{outcome.name}: poles, bars are 95 % intervals",
        )


def _uncertain_poles(identified: IdentifiedModel) -> list[tuple[float, float, float, float]]:
    """Real and imaginary part of each pole whose uncertainty is known, and their standard deviations [rad/s]."""
    found = identified.parameters
    rows = []
    for name in found.names:
        pole, _, part = name.partition(".")
        damping = name.replace("natural_frequency", "damping")
        if damping != name and damping in found.names:
            pair = found.part([name, damping])
            rows += [_row(pair.derived(("real", "imag"), parts)) for parts in _POLES[bool(pair.values[1] < 1.0)]]
        elif pole.startswith("pole_") and part == "real":
            rows.append(_row(found.part([name, f"{pole}.imag"])))
        elif pole.startswith("pole_") and not part:
            rows.append((found.value(name), 0.0, found.deviation(name), 0.0))
    return rows


def _row(pole: Estimate) -> tuple[float, float, float, float]:
    (real, imag), (real_deviation, imag_deviation) = pole.values, pole.standard_deviation
    return float(real), float(imag), float(real_deviation), float(imag_deviation)


def _root(damping: float) -> float:
    return float(np.sqrt(abs(damping**2 - 1.0)))


# From natural frequency and damping: both poles where they are real, the upper one of a pair that is complex.
_POLES: dict[bool, list[Callable[[FloatArray], FloatArray]]] = {
    False: [
        lambda row: np.array([-row[0] * (row[1] - _root(row[1])), 0.0]),
        lambda row: np.array([-row[0] * (row[1] + _root(row[1])), 0.0]),
    ],
    True: [lambda row: np.array([-row[0] * row[1], row[0] * _root(row[1])])],
}
