"""The composition root of the command line: which commands there are; the bare command serves.

A command is imported when it is asked for: the libraries of all of them together take 70 MB and a second.
"""

import importlib
import inspect
import os
import re
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from scanner_service import __version__
from scanner_service.commands.placeholders import put_placeholders

COMMANDS = {
    "serve": "serve:serve_command",
    "open": "open_viewer:open_command",
    "demo": "demo:demo_command",
    "scan": "scan:scan_command",
    "devices": "devices:devices_command",
    "doctor": "devices:doctor_command",
    "replay": "replay:replay_command",
    "analyse": "analyse:analyse_command",
    "rescan": "rescan:rescan_command",
    "compare": "compare:compare_command",
    "export": "export:export_command",
    "report": "report:report_command",
    "verify": "export:verify_command",
    "simulate": "simulate:simulate_command",
    "sessions": "sessions:sessions_app",
    "bench": "bench:bench_app",
}
"""Each command's file in `commands`, and its function there, or its application where it has commands of its own."""


class CommandsWhenAsked(TyperGroup):
    """The commands of COMMANDS, in that order, each imported when somebody asks for it."""

    def list_commands(self, ctx: Any) -> list[str]:
        """The names of all commands."""
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of that name, or None."""
        if cmd_name not in COMMANDS:
            return None
        module, name = COMMANDS[cmd_name].split(":")
        found = getattr(importlib.import_module(f"scanner_service.commands.{module}"), name)
        if not isinstance(found, typer.Typer):
            alone = typer.Typer(rich_markup_mode=None, pretty_exceptions_enable=False, add_completion=False)
            alone.command(cmd_name)(found)
            command = typer.main.get_command(alone)
        else:
            command = typer.main.get_group(found)
            command.name = cmd_name
        put_placeholders(command, cmd_name)
        _say_whole(command)
        return command


def _say_whole(command: Any) -> None:
    """Have lists of commands say the first sentence of each, however long; click would cut it to one line."""
    if command.help:
        command.short_help = re.split(r"(?<=\.)\s", inspect.cleandoc(command.help), maxsplit=1)[0]
    for each in getattr(command, "commands", {}).values():
        _say_whole(each)


app = typer.Typer(
    name="scanner",
    cls=CommandsWhenAsked,
    help="Live quality for laser-line scanning: density, normals, and what to scan again.",
    no_args_is_help=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


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
        serve = importlib.import_module("scanner_service.commands.serve")
        serve.serve_command(
            Path(os.environ.get("SCANNER_DATA") or serve.DEFAULT_DATA), record=os.environ.get("SCANNER_RECORD") or None
        )


def main() -> None:
    """The `scanner` command."""
    app()
