"""`scanner scan`: one pass of a rig, live, and the same files as from any other scan."""

import contextlib
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from scanner_service.commands.replay import play, tell
from scanner_service.commands.terminal import check_folder, errors, plain_errors, show_json
from scanner_service.rescan.requirement import Requirement
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.outputs import write_outputs
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import RigSpec
from scanner_service.storage.record import Record


def scan_command(
    rig: Annotated[Path, typer.Argument(help="Rig file (TOML); see docs/devices.")],
    start: Annotated[float, typer.Option(help="Stage position of the first line, mm.")],
    end: Annotated[float, typer.Option(help="Stage position of the last line, mm.")],
    line_spacing: Annotated[float, typer.Option(min=1e-4, help="Nominal line spacing, mm.")],
    speed: Annotated[
        float | None, typer.Option(min=1e-4, help="mm/s; by default the fastest that keeps the line spacing.")
    ] = None,
    at_rest: Annotated[bool, typer.Option("--at-rest", help="Stop for each line.")] = False,
    home: Annotated[bool, typer.Option("--home", help="Home the stage first.")] = False,
    at: Annotated[float | None, typer.Option(help="State where the stage is now, mm, instead of homing.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the result files.")] = Path("out"),
    density: Annotated[float | None, typer.Option(help="Required points per mm²; half the nominal by default.")] = None,
    record: Annotated[Path | None, typer.Option(help="Keep the session in this record file.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Scan one pass with a rig and write points.ply, density.png, regions.json and summary.json. It moves the stage."""
    with plain_errors(), tempfile.TemporaryDirectory(prefix="scanner-scan-") as folder:
        if at_rest and speed is not None:
            raise ValueError("a pass is measured at a speed or at rest: leave out --speed or --at-rest")
        if home and at is not None:
            raise ValueError("the stage is homed or told where it is: leave out --home or --at")
        spec = RigSpec(rig, line_spacing, start, end, 0.0 if at_rest else speed, home, at)
        check_folder(out)
        with Record.open(record or Path(folder) / "record.sqlite") as opened, contextlib.ExitStack() as stack:
            source = spec.open()
            stack.callback(source.stop)  # whatever happens, the stage rests and the laser is off
            book = SessionBook(opened)
            stack.callback(book.close)
            live = book.create(
                rig.name, spec, SessionSettings(target=Requirement(density_per_mm2=density)), (0.0, 0.0, 0.0), source
            )
            play(live, quiet=as_json)
            said, summary = live.status().message, write_outputs(out, live)
            if said and said not in summary["notes"]:
                errors.print(f"note: {said}", highlight=False, soft_wrap=True)
            results = live.results()
        if as_json:
            show_json(summary)
        elif results is not None:
            tell(results.regions_dict()["regions"], summary, out)
