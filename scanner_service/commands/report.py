"""`scanner report`: a session as one HTML file and one PDF, for people who were not there."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from scanner_service.commands.data_folder import DEFAULT_DATA
from scanner_service.commands.options import Data, RecordFile, meshes_in, open_reader
from scanner_service.commands.terminal import check_folder, console, errors, plain_errors, show_json, work_progress
from scanner_service.sessions.exporting import REPORT, REPORT_FILES, export_session
from scanner_service.sessions.stored import find_session


def report_command(
    session: Annotated[str, typer.Argument(help="The session's id, its first letters, or `latest`.")],
    out: Annotated[Path, typer.Option(help="Folder for the two files and their manifest.")] = Path("out"),
    data: Data = DEFAULT_DATA,
    record: RecordFile = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the manifest as JSON.")] = False,
) -> None:
    """Write report.html and report.pdf: pictures, histogram, coverage by pass, regions, losses, settings, hashes."""
    with plain_errors():
        check_folder(out)
        with open_reader(data, record) as reader, work_progress("reporting", as_json) as progress:
            row = find_session(reader, session)
            now, meshes = datetime.now(UTC), meshes_in(data)
            manifest = export_session(reader, row, [REPORT], out, now, progress.show, meshes=meshes)
        if manifest["reference_refused"]:
            errors.print(f"note: {manifest['reference_refused']}", highlight=False, soft_wrap=True)
        if as_json:
            show_json(manifest)
            return
        files = " and ".join(str(out / name) for name in REPORT_FILES)
        console.print(f"Written: {files}", highlight=False, soft_wrap=True)
