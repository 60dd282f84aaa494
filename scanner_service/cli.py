"""The composition root of the command line: which commands there are; the bare command serves."""

import os
from pathlib import Path
from typing import Annotated

import typer

from scanner_service import __version__
from scanner_service.commands.analyse import analyse_command
from scanner_service.commands.bench import bench_app
from scanner_service.commands.compare import compare_command
from scanner_service.commands.demo import demo_command
from scanner_service.commands.devices import devices_command, doctor_command
from scanner_service.commands.export import export_command, verify_command
from scanner_service.commands.open_viewer import open_command
from scanner_service.commands.replay import replay_command
from scanner_service.commands.report import report_command
from scanner_service.commands.rescan import rescan_command
from scanner_service.commands.scan import scan_command
from scanner_service.commands.serve import DEFAULT_DATA, serve_command
from scanner_service.commands.sessions import sessions_app
from scanner_service.commands.simulate import simulate_command

app = typer.Typer(
    name="scanner",
    help="Live quality for laser-line scanning: density, normals, and what to scan again.",
    no_args_is_help=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.command("serve")(serve_command)
app.command("open")(open_command)
app.command("demo")(demo_command)
app.command("scan")(scan_command)
app.command("devices")(devices_command)
app.command("doctor")(doctor_command)
app.command("replay")(replay_command)
app.command("analyse")(analyse_command)
app.command("rescan")(rescan_command)
app.command("compare")(compare_command)
app.command("export")(export_command)
app.command("report")(report_command)
app.command("verify")(verify_command)
app.command("simulate")(simulate_command)
app.add_typer(sessions_app, name="sessions")
app.add_typer(bench_app, name="bench")


def _tell_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback(invoke_without_command=True)
def bare(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_tell_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Without a command: serve with the defaults."""
    if context.invoked_subcommand is None:
        serve_command(
            Path(os.environ.get("SCANNER_DATA") or DEFAULT_DATA), record=os.environ.get("SCANNER_RECORD") or None
        )


def main() -> None:
    """The `scanner` command."""
    app()
