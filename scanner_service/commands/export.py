"""`scanner export` and `scanner verify`: a session as files with a manifest, and whether they are still the same."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from scanner_service.commands.data_folder import DEFAULT_DATA
from scanner_service.commands.options import Data, RecordFile, meshes_in, open_reader
from scanner_service.commands.terminal import (
    check_folder,
    console,
    errors,
    fail,
    plain_errors,
    show_json,
    work_progress,
)
from scanner_service.sessions.exporting import FORMATS, check_formats, export_session
from scanner_service.sessions.memory_bound import points_at_once as points_that_fit
from scanner_service.sessions.stored import find_session
from scanner_service.storage.exports.manifest import MANIFEST, verify_folder


def export_command(
    session: Annotated[str, typer.Argument(help="The session's id, its first letters, or `latest`.")],
    formats: Annotated[
        list[str] | None, typer.Option("--format", help=f"One of {', '.join(FORMATS)}, or all; repeat it for more.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the files and their manifest.")] = Path("out"),
    data: Data = DEFAULT_DATA,
    record: RecordFile = None,
    memory_mb: Annotated[
        int | None,
        typer.Option(min=1, help="Memory to use; a session that needs more is written in slabs, without regions."),
    ] = None,
    points_at_once: Annotated[
        int | None, typer.Option(min=1, help="The same as a number of points that are held at once.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the manifest as JSON.")] = False,
) -> None:
    """Write a session in other programs' formats, with a manifest of hashes; PLY when no format is named."""
    with plain_errors():
        wanted = [part for given in formats or ["ply"] for part in given.lower().split(",")]
        if memory_mb is not None and points_at_once is not None:
            raise ValueError("--memory-mb and --points-at-once say the same: leave one of them out")
        bound = points_at_once if memory_mb is None else points_that_fit(memory_mb << 20)
        check_formats(wanted)
        check_folder(out)
        with open_reader(data, record) as reader, work_progress("exporting", as_json) as progress:
            row = find_session(reader, session)
            manifest = export_session(
                reader, row, wanted, out, datetime.now(UTC), progress.show, bound, meshes_in(data)
            )
        for name, why in manifest["left_out"].items():
            errors.print(f"not written: {name}: {why}", highlight=False, soft_wrap=True)
        for damaged in manifest["damaged_lines"]:
            errors.print(f"left out: {damaged}", highlight=False, soft_wrap=True)
        if manifest.get("reference_refused"):
            errors.print(f"note: {manifest['reference_refused']}", highlight=False, soft_wrap=True)
        if as_json:
            show_json(manifest)
            return
        for name, said in manifest["files"].items():
            console.print(
                f"{said['sha256']}  {out / name}  {said['bytes'] / 1e6:,.1f} MB", highlight=False, soft_wrap=True
            )
        console.print(
            f"{manifest['points']:,} points of session {row.session_id}; {out / MANIFEST} lists the files, "
            f"and `scanner verify {out}` compares them with it",
            highlight=False,
            soft_wrap=True,
        )


def verify_command(
    folder: Annotated[Path, typer.Argument(help="A folder that `scanner export` wrote.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print what was found as JSON.")] = False,
) -> None:
    """Compare exported files with their manifest; ends with 1 when anything is not what was written."""
    with plain_errors():
        found = verify_folder(folder)
        if as_json:
            facts = {name: found.manifest.get(name) for name in ("session", "version", "raw_sha256", "verdict_sha256")}
            show_json({"sound": found.sound, "problems": found.problems, "unlisted": found.unlisted, **facts})
        else:
            for name in found.sound:
                console.print(f"sound      {name}", highlight=False)
            for problem in found.problems:
                console.print(f"NOT SOUND  {problem}", highlight=False, soft_wrap=True)
            for name in found.unlisted:
                console.print(f"unlisted   {name} is not in the manifest", highlight=False, soft_wrap=True)
        if found.problems:
            fail(f"{len(found.problems)} of {len(found.sound) + len(found.problems)} files are not what was written")
