"""The command line `diffdrive-mpc`. Commands live in `bench.commands`, and import what they need when they run."""

from __future__ import annotations

from typing import Annotated

import typer

from diffdrive_mpc.bench.commands import (
    animate,
    campaign,
    commission,
    doctor,
    excite,
    export,
    identify,
    monitor,
    plan,
    prove,
    real_logs,
    replay,
    ros,
    schema,
    studies,
    tune,
    twin,
)
from diffdrive_mpc.bench.commands.config import config_app
from diffdrive_mpc.bench.commands.log import log_app
from diffdrive_mpc.bench.commands.models import models_app
from diffdrive_mpc.bench.commands.one_line_errors import OneLineErrors, leave_on_sigterm
from diffdrive_mpc.bench.commands.options import PASSED_ON

app = typer.Typer(
    cls=OneLineErrors,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Model-predictive trajectory tracking for skid-steer and differential-drive robots.",
)
app.command("simulate", epilog=studies.EXAMPLES["simulate"])(studies.simulate)
app.command("animate", epilog=animate.EXAMPLE)(animate.animate)
app.command("bench", epilog=studies.EXAMPLES["bench"])(studies.bench)
app.command("identify", epilog=identify.EXAMPLE)(identify.identify)
app.command("replay", epilog=replay.EXAMPLE)(replay.replay)
app.command("twin", epilog=twin.EXAMPLE)(twin.twin)
app.command("tracking", epilog=studies.EXAMPLES["tracking"])(studies.tracking)
app.command("real-logs", epilog=real_logs.EXAMPLE)(real_logs.real_logs)
app.command("reproduce", epilog=studies.EXAMPLES["reproduce"])(studies.reproduce)
app.command("peers", epilog=studies.EXAMPLES["peers"])(studies.peers)
app.command("energy-front", epilog=studies.EXAMPLES["energy-front"])(studies.energy_front)
app.command("torque", epilog=studies.EXAMPLES["torque"])(studies.torque)
app.command("saving", epilog=studies.EXAMPLES["saving"])(studies.saving)
app.command("plan", epilog=plan.EXAMPLE)(plan.plan)
app.command("robustness", epilog=studies.EXAMPLES["robustness"])(studies.robustness)
app.command("worlds", epilog=studies.EXAMPLES["worlds"])(studies.worlds)
app.command("campaign", epilog=campaign.EXAMPLE)(campaign.campaign)
app.command("prove", epilog=prove.EXAMPLE)(prove.prove)
app.command("commission", epilog=commission.EXAMPLE)(commission.commission)
app.command("tune", epilog=tune.EXAMPLE)(tune.tune)
app.command("speed", epilog=studies.EXAMPLES["speed"])(studies.speed)
app.command("loop-speed", epilog=studies.EXAMPLES["loop-speed"])(studies.loop_speed)
app.command("excite", epilog=excite.EXAMPLE)(excite.excite)
app.command("export", epilog=export.EXAMPLE)(export.export)
app.command("node", epilog=ros.EXAMPLES["node"], context_settings=PASSED_ON)(ros.node)
app.command("robot", epilog=ros.EXAMPLES["robot"], context_settings=PASSED_ON)(ros.robot)
app.command("monitor", epilog=monitor.EXAMPLES["monitor"], context_settings=PASSED_ON)(monitor.monitor)
app.command("monitor-study", epilog=monitor.EXAMPLES["monitor-study"])(monitor.monitor_study)
app.command("doctor", epilog=doctor.EXAMPLE)(doctor.doctor)
app.command("schema", epilog=schema.EXAMPLE)(schema.schema)
app.add_typer(config_app, name="config")
app.add_typer(log_app, name="log")
app.add_typer(models_app, name="models")


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"diffdrive-mpc {version('diffdrive-mpc')}")
        raise typer.Exit


@app.callback(epilog="Example: diffdrive-mpc bench --quick --out results")
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Model-predictive trajectory tracking for skid-steer and differential-drive robots."""


def main() -> None:
    """Entry point of the console command."""
    leave_on_sigterm()
    app(prog_name="diffdrive-mpc")
