"""`scanner replay`: a recorded scan through the same pipeline, and the same files as from a live one."""

import contextlib
import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from scanner_service.commands.options import parse_interest, parse_position, parse_units
from scanner_service.commands.terminal import (
    check_folder,
    console,
    errors,
    loss_sentence,
    plain_errors,
    scan_progress,
    show_json,
    tell_regions,
)
from scanner_service.rescan.presets import requirement_of
from scanner_service.rescan.reference import ReferenceSurface
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.outputs import OUTPUT_FILES, write_outputs
from scanner_service.sessions.references import open_reference
from scanner_service.sessions.session import LiveSession
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import RecordSpec, ReplaySpec
from scanner_service.storage.database import is_sqlite
from scanner_service.storage.formats.recording import ReadOptions
from scanner_service.storage.formats.reference_mesh import ReferenceSpec
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.record import Record


def replay_command(
    file: Annotated[Path, typer.Argument(help="PLY with a range_grid, CSV profiles, or a record of this service.")],
    out: Annotated[Path, typer.Option(help="Folder for the result files.")] = Path("out"),
    units: Annotated[str | None, typer.Option(help="Length unit of the file: mm, m, inch or auto.")] = None,
    line_spacing: Annotated[float | None, typer.Option(help="Line spacing in mm; derived when not given.")] = None,
    laser: Annotated[str | None, typer.Option(help="Laser position x,y,z in mm; an open coordinate is `-`.")] = None,
    plain_radius: Annotated[
        bool, typer.Option("--plain-radius", help="Ignore the point spacing (plain Eq. 6.3).")
    ] = False,
    density: Annotated[float | None, typer.Option(help="Required points per mm²; half the nominal by default.")] = None,
    preset: Annotated[str | None, typer.Option(help="Requirement: overview, standard, inspection or fine.")] = None,
    surface_spacing: Annotated[float | None, typer.Option(help="Largest line spacing on the surface, mm.")] = None,
    chord_error: Annotated[float | None, typer.Option(help="Largest chord error between two lines, mm.")] = None,
    incidence: Annotated[float | None, typer.Option(help="Largest incidence angle, degrees.")] = None,
    largest_noise: Annotated[float | None, typer.Option(help="Largest noise of the returns, mm.")] = None,
    coverage: Annotated[float | None, typer.Option(help="Share of the surface that must be good, 0 to 1.")] = None,
    interest: Annotated[str | None, typer.Option(help="Box x,y,z,x,y,z in mm: only surface in it is judged.")] = None,
    reference: Annotated[Path | None, typer.Option(help="Nominal part (STL, OBJ), registered to the scan.")] = None,
    reference_units: Annotated[str, typer.Option(help="Length unit of the nominal part: mm, m or inch.")] = "mm",
    noise: Annotated[
        float | None, typer.Option(min=0, help="The scanner's noise in mm, one standard deviation; 0 by default.")
    ] = None,
    speed: Annotated[float | None, typer.Option(help="Times real time; as fast as possible by default.")] = None,
    session: Annotated[str | None, typer.Option(help="Which session of a record; the newest by default.")] = None,
    record: Annotated[Path | None, typer.Option(help="Keep the replayed session in this record file.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Replay a recorded scan and write points.ply, density.png, regions.json and summary.json."""
    with plain_errors(), tempfile.TemporaryDirectory(prefix="scanner-replay-") as folder:
        with Record.open(record or Path(folder) / "record.sqlite") as opened, contextlib.ExitStack() as stack:
            spec: RecordSpec | ReplaySpec
            nominal: ReferenceSurface | None = None
            if is_sqlite(file):
                _refuse_what_a_record_knows(
                    units=units, line_spacing=line_spacing, laser=laser, density=density, noise=noise,
                    plain_radius=plain_radius or None, preset=preset, surface_spacing=surface_spacing,
                    chord_error=chord_error, incidence=incidence, largest_noise=largest_noise, coverage=coverage,
                    interest=interest, reference=reference,
                )  # fmt: skip
                reader = RecordReader.open(file)
                stack.callback(reader.close)
                spec = RecordSpec.find(reader, session, speed)
                source, settings, origin_mm = (
                    spec.open(),
                    SessionSettings.from_dict(spec.session.settings),
                    spec.session.origin_mm,
                )
            else:
                spec = ReplaySpec(file, ReadOptions(parse_units(units), parse_position(laser), line_spacing), speed)
                recording = spec.read()
                for note in recording.notes:
                    errors.print(f"note: {note}", highlight=False, soft_wrap=True)
                source, origin_mm = spec.open(recording), (0.0, 0.0, 0.0)
                settings = SessionSettings(
                    point_spacing_mm=0.0 if plain_radius else _known(recording.point_spacing_mm),
                    noise_mm=noise or 0.0,
                    target=requirement_of(
                        preset,
                        density_per_mm2=density,
                        line_spacing_mm=surface_spacing,
                        chord_error_mm=chord_error,
                        incidence_rad=None if incidence is None else math.radians(incidence),
                        noise_mm=largest_noise,
                        coverage_share=coverage,
                        interest=parse_interest(interest),
                    ),
                )
                if reference is not None:
                    found = ReferenceSpec(reference.name, reference_units)
                    nominal, found = open_reference(found, reference.absolute().parent)
                    settings = replace(settings, reference=found)
            check_folder(out)
            book = SessionBook(opened, meshes=file.absolute().parent)
            stack.callback(book.close)
            live = book.create(file.name, spec, settings, origin_mm, source, reference=nominal)
            play(live, quiet=as_json)
            summary = write_outputs(out, live)
            results = live.results()
            if results is not None and results.reference_refused is not None:
                if nominal is not None:
                    raise ValueError(results.reference_refused)
                errors.print(f"note: {results.reference_refused}", highlight=False, soft_wrap=True)
        if as_json:
            show_json(summary)
        elif results is not None:
            tell(results.regions_dict()["regions"], summary, out)


def play(session: LiveSession, quiet: bool) -> None:
    """Run the session to its end."""
    session.start()
    with scan_progress("replaying", quiet) as progress:
        while not session.wait_until_over(0.2):
            progress.show(_facts(session))
        progress.show(_facts(session))
    if session.state == "failed":
        raise ValueError(session.status().message or "the replay failed")


def _facts(session: LiveSession) -> dict[str, Any]:
    status = session.status()
    return {
        name: getattr(status, name)
        for name in ("lines", "points_per_s", "coverage", "coverage_kind", "progress", "losses")
    }


def tell(regions: Any, summary: dict[str, Any], out: Path) -> None:
    """Print the regions as a table, and what the scan came to."""
    tell_regions(regions)
    for note in summary["notes"]:
        console.print(f"note: {note}", highlight=False, soft_wrap=True)
    share, held = summary["coverage"]["share"], summary["coverage"]["holds"]
    nominal = summary["coverage"]["kind"] == "reference"
    console.print(
        f"{summary['points']:,} points in {summary['scanlines']:,} scanlines, line spacing "
        f"{summary['line_spacing_mm']['median']:.3f} mm, radius {summary['radius_mm']['median']:.3f} mm, "
        f"{summary['reliable_share']:.1%} with a reliable normal; "
        f"{'coverage of the nominal part' if nominal else 'observed coverage'} "
        f"{'unknown' if math.isnan(share) else format(share, '.1%')} "
        f"({summary['coverage']['gap_mm2']:,.0f} mm² of gaps)"
        + ("" if held is None else f"; the coverage asked for is {'reached' if held else 'not reached'}"),
        highlight=False,
    )
    console.print(loss_sentence(summary["losses"]), highlight=False, soft_wrap=True)
    console.print(f"SHA-256 of the verdict: {summary['verdict_sha256']}", highlight=False, soft_wrap=True)
    console.print(f"Written to {out}: {', '.join(OUTPUT_FILES)}", highlight=False, soft_wrap=True)


def _refuse_what_a_record_knows(**options: object) -> None:
    """A record is played with the settings it was taken with: an option that would be without effect is an error."""
    given = [f"--{name.replace('_', '-')}" for name, value in options.items() if value is not None]
    if given:
        raise ValueError(f"a record is replayed with its own settings: leave out {', '.join(given)}")


def _known(value_mm: float) -> float | None:
    return None if math.isnan(value_mm) else value_mm
