"""Figures of the study `reproduce`: responses, odometry, trainings, orders, and the virtual track."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.load import load_linear_model
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.models.velocity_model import CHANNELS
from studies.reproduce.drives import QUANTITIES, discretise, trajectory_commands
from studies.reproduce.mbm_and_sm import COMPARED, MBM, SM, MbmSmResult
from studies.reproduce.networks import LSTM, MEASURED, SSM, NetworkRow
from studies.reproduce.published import load_published
from studies.reproduce.state_space import PAPERS_ORDER, SsmResult, published_system
from studies.reproduce.virtual_track import TrackLine, VirtualTrackResult

_BAR = 0.16
"""Width of a bar, relative to the distance of two groups [-]."""
_PARTS = {"position": slice(2), "heading": slice(2, 3)}
"""Columns of a pose by name of the quantity."""


def draw_odometry(results: Sequence[MbmSmResult], path: Path) -> None:
    """Draw the paths of the first repetition, and the mean RMSE of all repetitions."""
    first = results[0]
    with new_figure(path, 10.0, 6.2) as figure:
        halves = figure.add_gridspec(2, 1)
        upper, lower = (figure.add_subfigure(halves[row]) for row in (0, 1))
        upper.suptitle("Driven paths of the simulated robot, and paths predicted from commands alone")
        for axes, (name, paths) in zip(
            upper.subplots(1, len(first.paths), squeeze=False)[0], first.paths.items(), strict=True
        ):
            _draw_paths(axes, paths)
            axes.set_title(name)
            if name == next(iter(first.paths)):
                axes.legend(loc="center", fontsize=7.0)
        for axes, quantity in zip(lower.subplots(1, 2), QUANTITIES, strict=True):
            _draw_error_bars(axes, results, quantity)
        lower.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=5)


def _draw_paths(axes: Axes, paths: Mapping[str, FloatArray]) -> None:
    axes.plot(*paths["driven"][:, :2].T, color=REFERENCE_COLOUR, linewidth=3.0, label="driven")
    for k, model in enumerate(COMPARED):
        axes.plot(*paths[model][:, :2].T, color=colour(k), linestyle=line_style(k), linewidth=1.1, label=model)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")


def _draw_error_bars(axes: Axes, results: Sequence[MbmSmResult], quantity: str) -> None:
    names = list(results[0].errors[SM])
    published = load_published().odometry
    bars: dict[str, tuple[list[float], str, str]] = {
        f"published {model.upper()}": (
            [getattr(published[model][name], quantity)[0] for name in names],
            colour(0 if model == "mbm" else 2),
            "//",
        )
        for model in ("mbm", "sm")
    }
    for k, model in enumerate(COMPARED):
        values = [
            float(np.mean([getattr(result.errors[model][name], quantity).rmse for result in results])) for name in names
        ]
        bars[model] = (values, colour(k), "")
    for k, (label, (values, bar_colour, hatch)) in enumerate(bars.items()):
        positions = np.arange(len(names)) + (k - 2) * _BAR
        axes.bar(positions, values, _BAR, color=bar_colour, hatch=hatch, edgecolor="white", linewidth=0.4, label=label)
    axes.set(yscale="log", ylabel=f"{quantity} RMSE [{QUANTITIES[quantity]}]", title=quantity)
    axes.set_xticks(range(len(names)), names)
    axes.grid(axis="x", visible=False)


def draw_error_maps(results: Sequence[MbmSmResult], path: Path) -> None:
    """Draw commands and errors along the trajectories of the first repetition; a cross marks the maximum error."""
    with new_figure(path, 12.0, 12.0) as figure:
        columns = figure.subplots(1 + 2 * len(QUANTITIES), len(results[0].paths), squeeze=False).T
        for column, (name, paths) in zip(columns, results[0].paths.items(), strict=True):
            commands = trajectory_commands(name)
            for label, values, style in zip(("v [m/s]", "omega [rad/s]"), commands.T, ("-", "--"), strict=True):
                column[0].plot(_times(len(commands)), values, style, label=label)
            column[0].set(title=name, xlabel="time [s]", ylim=(-1.2, 1.2))
            _draw_error_maps(column[1:], paths["driven"], {model: paths[model] for model in (MBM, SM)})
        columns[0][0].legend(loc="lower left", fontsize=7.0)


def _draw_error_maps(grid: Sequence[Axes], driven: FloatArray, predicted: Mapping[str, FloatArray]) -> None:
    """Draw predicted paths coloured by their error: position by model, then heading by model."""
    for k, (quantity, unit) in enumerate(QUANTITIES.items()):
        errors = [np.linalg.norm((poses - driven)[:, _PARTS[quantity]], axis=1) for poses in predicted.values()]
        for axes, error, (model, poses) in zip(grid[k * len(errors) :], errors, predicted.items(), strict=False):
            axes.plot(*driven[:, :2].T, color=REFERENCE_COLOUR, linewidth=0.8)
            mesh = axes.scatter(poses[:, 0], poses[:, 1], c=error, s=5.0, vmin=0.0, vmax=max(map(np.max, errors)))
            axes.plot(*poses[error.argmax(), :2], "x", color="black")
            axes.set(title=f"{model}: {error.max():.3f} {unit}", aspect="equal")
            axes.figure.colorbar(mesh, ax=axes, label=f"{quantity} error [{unit}]")


def draw_experiment(motions: Mapping[str, FloatArray], path: Path) -> None:
    """Draw errors and velocities of SSM and LSTM on a free drive (P1, Figures 6 and 7)."""
    with new_figure(path, 12.0, 6.0) as figure:
        grid = figure.subplots(2, 3)
        _draw_error_maps(grid[:, :2].flat, motions[MEASURED], {name: motions[name] for name in (SSM, LSTM)})
        for k, (axes, quantity) in enumerate(zip(grid[:, 2], ("v [m/s]", "omega [rad/s]"), strict=True), start=3):
            for name, line_colour in ((MEASURED, "black"), (SSM, colour(0)), (LSTM, colour(1))):
                axes.plot(_times(len(motions[name])), motions[name][:, k], color=line_colour, linewidth=0.9, label=name)
            axes.set(xlabel="time [s]", ylabel=quantity)
        axes.legend(loc="best", fontsize=7.0)


def draw_training(rows: Sequence[NetworkRow], path: Path) -> None:
    """Draw the validation error of each network during its training (P1, Figure 3)."""
    with new_figure(path, 9.0, 4.0) as figure:
        axes = figure.subplots()
        for k, row in enumerate(sorted(rows, key=lambda row: row.row)):
            steps = load_published().networks[row.row].validation_every * np.arange(len(row.losses))
            axes.plot(
                steps, np.sqrt(2.0 * row.losses), color=colour(k), linestyle=line_style(k), label=f"row {row.row}"
            )
        axes.set(
            xlabel="training step", ylabel="RMSE of v [m/s] and omega [rad/s] together", xscale="symlog", yscale="log"
        )
        loss = axes.secondary_yaxis(
            "right", functions=(lambda rmse: 0.5 * np.square(rmse), lambda loss: np.sqrt(np.multiply(2.0, loss)))
        )
        loss.set_ylabel("loss: half the squared error")
        axes.legend(ncols=3)


def draw_responses(results: Sequence[MbmSmResult], path: Path) -> None:
    """Draw measured and simulated speeds of the validation steps: MBM simulates the motors, SM v and omega."""
    with new_figure(path, 11.0, 5.6) as figure:
        grid = figure.subplots(2, 3).flat
        for axes, (name, speeds) in zip(grid, results[0].responses.items(), strict=False):
            axes.plot(_times(len(speeds)), speeds, linewidth=1.0, label=("measured", "simulated"))
            unit, model = ("m/s", "SM") if name == "v" else ("rad/s", "SM" if name in CHANNELS else "MBM")
            axes.set(title=f"{model}, {name}", xlabel="time [s]", ylabel=f"speed [{unit}]")
        grid[0].legend(loc="best")


def draw_steps(_: Sequence[SsmResult], path: Path) -> None:
    """Draw the responses of v and omega to a unit step of each command, from the published matrices of SSM."""
    dt = load_robot().sample_time
    model, rows = discretise(published_system(load_linear_model("ssm")), dt), round(1.2 / dt)
    with new_figure(path, 9.0, 3.2) as figure:
        for axes, channel, command in zip(figure.subplots(1, 2), CHANNELS, np.eye(2), strict=True):
            axes.plot(_times(rows), model.simulate(np.tile(command, (rows, 1))), label=CHANNELS)
            axes.set(title=f"unit step of {channel}", xlabel="time [s]", ylabel="v [m/s], omega [rad/s]")
            axes.legend()


def _times(count: int) -> FloatArray:
    return load_robot().sample_time * np.arange(count, dtype=float)


def draw_orders(results: Sequence[SsmResult], path: Path) -> None:
    """Draw the improvement of each order over order 2, in v and in omega; error bars show the range of repetitions."""
    published = load_published().orders
    orders = [row.order for row in results[0].orders if row.order >= PAPERS_ORDER]
    with new_figure(path, 9.0, 3.4) as figure:
        for row, (channel, axes) in enumerate(zip(CHANNELS, figure.subplots(1, 2), strict=True)):
            paper = {order: getattr(fit.fit_percent, channel) for order, fit in published.items()}
            axes.plot(
                list(paper),
                [value - paper[PAPERS_ORDER] for value in paper.values()],
                "s--",
                color=colour(1),
                label=f"published; order 2: {paper[PAPERS_ORDER]:.2f} %",
            )
            fits = np.array(
                [[result.orders[order - 1].test.fit_percent[row] for order in orders] for result in results]
            )
            improvements = fits - fits[:, :1]
            mean = improvements.mean(axis=0)
            deviations = np.abs(np.array([improvements.min(axis=0), improvements.max(axis=0)]) - mean)
            label = f"our plant; order 2: {fits[:, 0].mean():.2f} %"
            axes.errorbar(orders, mean, yerr=deviations, fmt="o-", color=colour(0), capsize=3.0, label=label)
            axes.axhline(0.0, color="black", linewidth=0.6)
            axes.set(title=channel, xlabel="order", xticks=orders, ylabel="test FIT over order 2 [points]")
            axes.legend(loc="best")


def draw_virtual_track(result: VirtualTrackResult, path: Path) -> None:
    """Draw the tests as published, and with exchanged tracks, each with the published and the fitted line."""
    with new_figure(path, 9.0, 3.6) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        _draw_track_tests(left, result.tests, result.printed, result.fitted)
        _draw_track_tests(right, result.exchanged, result.printed, result.fitted_exchanged)
        left.set(title="tests as printed", ylabel="virtual track [m]")
        right.set_title("tracks of tests 1, 2 and 7, 8 exchanged")


def _draw_track_tests(axes: Axes, tests: FloatArray, published: TrackLine, fitted: TrackLine) -> None:
    rates = np.array([0.0, 1.1])
    for k, (name, line) in enumerate({"printed": published, "least squares": fitted}.items()):
        label = f"{name}: {line.p1:.3f} |yaw rate| + {line.p0:.3f}"
        axes.plot(rates, line.p1 * rates + line.p0, color=colour(k), linestyle=line_style(k), label=label)
    axes.plot(*tests.T, "o", color="black", markersize=4.0)
    for number, (rate, track) in enumerate(tests, start=1):
        axes.annotate(str(number), (rate, track), (4, 3), textcoords="offset points", fontsize=7.0)
    axes.axhline(published.p0, color=REFERENCE_COLOUR, linewidth=0.8)
    axes.annotate("true track", (1.1, published.p0), (-36, -9), textcoords="offset points", fontsize=7.0)
    axes.set_xlabel("yaw rate [rad/s]")
    axes.legend(loc="lower center")
    axes.margins(y=0.15)
