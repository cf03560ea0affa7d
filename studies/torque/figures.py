"""The figures of the torque study; numbers of figures in titles are those of Ordonez et al., 2017."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.figure_style import MARKERS, REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.costs_from_log.figures import torque_axes
from diffdrive_mpc_extras.terrain import Terrain, side_torques
from diffdrive_mpc_extras.turn_costs import DriveConstants, Vehicle
from studies.torque.measurements import sides
from studies.torque.outcome import CLOSE, FloorOutcome, PayloadOutcome

_RADII = np.geomspace(0.3, 300.0, 80)


def draw_torques(floor: FloorOutcome, vehicle: Vehicle, path: Path) -> None:
    """Measured torques at each speed, and the fitted shear law (figure 6)."""
    with new_figure(path, 6.4, 3.8) as figure:
        axes = figure.subplots()
        for k, (speed, steady) in enumerate(floor.steady.items()):
            for name, values, filled in (("outer", steady.outer, True), ("inner", steady.inner, False)):
                face = colour(k) if filled else "none"
                label = f"{name}, {speed:g} m/s"
                axes.plot(steady.radius, values, MARKERS[k], color=colour(k), markerfacecolor=face, label=label)
        ground = floor.fitted.on(Terrain(description=floor.surface))
        torques = side_torques(vehicle, ground, _RADII, 0.4)
        axes.plot(_RADII, torques.outer, color=REFERENCE_COLOUR, label="shear law")
        axes.plot(_RADII, torques.inner, "--", color=REFERENCE_COLOUR)
        torque_axes(axes, vehicle, f"Torques in steady turns on '{floor.surface}' (as figure 6)")
        axes.legend(ncols=2)


def draw_learned(floor: FloorOutcome, vehicle: Vehicle, speed: float, path: Path) -> None:
    """What was measured on the drive, and the curves before and after (figures 16 to 18)."""
    with new_figure(path, 6.4, 3.8) as figure:
        axes = figure.subplots()
        outer, inner, radii = _driven(floor)
        for values, shade in ((outer, colour(0)), (inner, colour(1))):
            axes.plot(radii, values, ".", color=shade, markersize=1.5, alpha=0.25, rasterized=True)
        steady = floor.steady[speed]
        axes.plot(steady.radius, steady.outer, "o", color=colour(0), label="outer, steady turns")
        axes.plot(steady.radius, steady.inner, "s", color=colour(1), label="inner, steady turns")
        for side, (learned, before) in enumerate(
            ((floor.learned.outer, floor.prior.outer), (floor.learned.inner, floor.prior.inner))
        ):
            axes.plot(_RADII, learned(_RADII), color=colour(side), label="learned" if not side else None)
            axes.plot(_RADII, before(_RADII), ":", color=colour(side), label="prior" if not side else None)
        if 0 < floor.learned_radius < np.inf:
            label = f"least radius {floor.learned_radius:.2f} m"
            axes.axvline(floor.learned_radius, color=colour(2), linestyle="-.", label=label)
        torque_axes(axes, vehicle, f"Learned on '{floor.surface}' (as figures 16 to 18)")
        axes.legend(ncols=2)


def draw_power(
    floors: Sequence[FloorOutcome], vehicle: Vehicle, constants: DriveConstants, prior: Terrain, path: Path
) -> None:
    """Electrical power of the sides: the published terrain by the model, and measured ones (figure 7)."""
    with new_figure(path, 6.4, 3.8) as figure:
        axes = figure.subplots()
        for k, speed in enumerate((0.2, 0.6)):
            torques = side_torques(vehicle, prior, _RADII, speed)
            sides_of = ((torques.outer, torques.outer_speed, "outer"), (torques.inner, torques.inner_speed, "inner"))
            for torque, wheels, name in sides_of:
                label = f"{name}, {prior.description.split()[0]}, {speed:g} m/s" if name == "outer" else None
                power = constants.side_power(torque, wheels)
                axes.plot(_RADII, power, line_style(k), color=colour(0 if name == "outer" else 1), label=label)
        for k, floor in enumerate(floors):
            steady = floor.steady[max(floor.steady)]
            heat = constants.side_heating * np.stack([steady.outer, steady.inner], -1) ** 2
            power = steady.power + heat
            label = f"'{floor.surface}', {max(floor.steady):g} m/s"
            axes.plot(steady.radius, power[:, 0], MARKERS[k], color=colour(2 + k), label=label)
            axes.plot(steady.radius, power[:, 1], MARKERS[k], color=colour(2 + k), markerfacecolor="none")
        axes.axhline(0.0, color=REFERENCE_COLOUR, linewidth=0.8)
        axes.set(xscale="log", xlabel="commanded turn radius [m]", ylabel="power of a side [W]")
        axes.set_title("Power of the sides; below zero it gives back (as figure 7)")
        axes.legend(ncols=2)


def draw_learning(floors: Sequence[FloorOutcome], path: Path) -> None:
    """How far off the curves are while the robot drives."""
    with new_figure(path, 6.4, 3.2) as figure:
        axes = figure.subplots()
        for k, floor in enumerate(floors):
            time, error = floor.history.T
            axes.plot(time, 100 * error, line_style(k), color=colour(k), label=floor.surface)
        axes.axhline(100 * CLOSE, color=REFERENCE_COLOUR, linewidth=0.8)
        axes.set(xlabel="time in the diagnostic drive [s]", ylabel="RMSE over RMS [%]", ylim=(0, None))
        axes.legend()


def draw_payloads(payloads: Sequence[PayloadOutcome], path: Path) -> None:
    """Torques under payloads, and what the terrain that was learned without any says of them."""
    with new_figure(path, 6.4, 3.6) as figure:
        axes = figure.subplots()
        for k, payload in enumerate(payloads):
            radii = payload.steady.radius
            axes.plot(radii, payload.steady.outer, MARKERS[k], color=colour(k), label=f"{payload.payload:g} kg")
            axes.plot(radii, payload.steady.inner, MARKERS[k], color=colour(k), markerfacecolor="none")
            axes.plot(radii, payload.predicted, color=colour(k))
        axes.set(xscale="log", xlabel="commanded turn radius [m]", ylabel="torque [N m]")
        axes.set_title("Measured (marks) and predicted from the drive without payload (lines)")
        axes.legend()


def draw_energy(floors: Sequence[FloorOutcome], path: Path) -> None:
    """Energy of unseen drives, predicted against measured (as figure 25)."""
    with new_figure(path, 4.2, 3.8) as figure:
        axes = figure.subplots()
        most = 0.0
        for k, floor in enumerate(floors):
            measured, predicted = (
                [energy.measured for energy in floor.energies],
                [energy.predicted for energy in floor.energies],
            )
            axes.plot(measured, predicted, MARKERS[k], color=colour(k), label=floor.surface)
            most = max(most, *measured, *predicted) if measured else most
        line = np.array([0.0, 1.1 * most])
        axes.plot(line, line, color=REFERENCE_COLOUR)
        axes.fill_between(line, 0.9 * line, 1.1 * line, color=REFERENCE_COLOUR, alpha=0.2, label="within 10 %")
        axes.set(xlabel="measured [J]", ylabel="predicted [J]")
        axes.legend()


def _driven(floor: FloorOutcome) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Outer and inner torques of each sample of the drive [N m], and the commanded radius [m]."""
    left, right = sides(floor.drive.motor_torque)
    v, omega = floor.drive.command.T
    turning_right = v * omega < 0
    return np.where(turning_right, left, right), np.where(turning_right, right, left), np.abs(v / omega)
