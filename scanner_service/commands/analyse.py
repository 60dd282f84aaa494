"""`scanner analyse`: density and normals of a plain cloud that has no scanlines."""

import importlib
import math
from pathlib import Path
from typing import Annotated, cast, get_args

import numpy as np
import typer

from scanner_service import __version__
from scanner_service.analysis.cloud import TURNED_UP, CloudRule, analyse_cloud
from scanner_service.analysis.method_analysis import METHOD_NAMES
from scanner_service.analysis.normals.field import NormalOptions
from scanner_service.analysis.snapshot import Unreliable
from scanner_service.commands.analyse_by_method import analyse_file_by_method, refuse
from scanner_service.commands.clouds import open_points
from scanner_service.commands.compiling_apart import compile_apart
from scanner_service.commands.options import parse_position, parse_units
from scanner_service.commands.orienting import orient_snapshot
from scanner_service.commands.small_memory import give_memory_back
from scanner_service.commands.terminal import check_folder, console, errors, plain_errors, show_json
from scanner_service.sessions.results import summarise_cloud
from scanner_service.storage.database import is_sqlite
from scanner_service.storage.exports.points_ply import write_points_ply
from scanner_service.storage.exports.results_json import write_json
from scanner_service.storage.exports.whole_file import write_whole
from scanner_service.storage.formats import ReadOptions, open_cloud
from scanner_service.storage.formats.normals_of import BY_ANALYSIS

NO_REGIONS = "a plain cloud has no scanlines, so it cannot be told where the scanner missed something, or why"


def analyse_command(
    file: Annotated[Path, typer.Argument(help="PLY, PCD, LAS, LAZ, E57, XYZ or CSV; with --method also a record.")],
    out: Annotated[Path, typer.Option(help="Folder for the result files.")] = Path("out"),
    radius: Annotated[float | None, typer.Option(help="One radius in mm for all points.")] = None,
    rule: Annotated[str | None, typer.Option(help="fixed, flexible (20 points each) or global (median).")] = None,
    units: Annotated[str | None, typer.Option(help="Length unit of the file: mm, m, inch or auto.")] = None,
    max_radius: Annotated[float | None, typer.Option(help="Largest radius in mm; 2 by default.")] = None,
    seen_from: Annotated[str | None, typer.Option(help="x,y,z in mm that normals are turned to.")] = None,
    density: Annotated[float | None, typer.Option(help="Required points per mm².")] = None,
    orient: Annotated[bool, typer.Option("--orient", help="Turn normals to the outside, and say how sure.")] = False,
    method: Annotated[
        str | None, typer.Option(help="Normals or curvatures by another method: " + ", ".join(METHOD_NAMES) + ".")
    ] = None,
    neighbours: Annotated[int | None, typer.Option(help="With --method: points of a neighbourhood.")] = None,
    noise: Annotated[float | None, typer.Option(help="With --method: noise in mm; estimated when not given.")] = None,
    floor: Annotated[float | None, typer.Option(help="With --method: least radius in mm.")] = None,
    ceiling: Annotated[float | None, typer.Option(help="With --method: largest radius in mm.")] = None,
    ball_factor: Annotated[float | None, typer.Option(help="With --method: when a Delaunay ball is big.")] = None,
    max_error: Annotated[float, typer.Option(help="With --method: normals less certain (degrees) are left out.")] = 5.0,
    session: Annotated[str | None, typer.Option(help="With --method: session of a record: id, first letters.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Analyse a cloud with a given radius or one of the chapter's rules, and write the result files."""
    give_memory_back()
    with plain_errors():
        if orient and seen_from is not None:
            raise ValueError("--seen-from tells the side of each normal, --orient finds it: leave one of them out")
        stated: dict[str, object] = {"neighbours": neighbours, "noise": noise, "floor": floor, "ceiling": ceiling}
        stated |= {"ball-factor": ball_factor, "session": session}
        if method is not None:
            without: dict[str, object] = {"rule": rule, "max-radius": max_radius, "density": density}
            refuse(without, f"leave it out with --method {method}")
            options = NormalOptions(
                radius_mm=radius,
                neighbours=neighbours,
                noise_mm=noise,
                floor_mm=floor,
                ceiling_mm=ceiling,
                ball_factor=ball_factor,
                max_error_rad=math.radians(max_error),
            )
            analyse_file_by_method(
                open_points(file, units, session), method, options, parse_position(seen_from), out, as_json, orient
            )
            return
        refuse(stated, "it belongs to --method")
        chosen = _rule(rule, radius)
        check_folder(out)
        if is_sqlite(file):
            raise ValueError(f"{file.name} is a record: say --method M for its points, or `scanner replay` for its map")
        cloud = open_cloud(file, ReadOptions(parse_units(units)))
        position = parse_position(seen_from)
        compile_apart(None, len(cloud.points_mm))
        with errors.status("computing density and normals …"):
            found = analyse_cloud(
                cloud.points_mm,
                chosen,
                radius_mm=radius,
                max_radius_mm=max_radius,
                seen_from_mm=None if position is None else np.array(position),
            )
        snapshot, notes = found.snapshot, (*cloud.notes, *found.notes)
        oriented = {}
        if orient:
            with errors.status("orienting normals …"):
                snapshot, oriented["orientation"], told = orient_snapshot(snapshot, out)
            notes = (*(note for note in notes if note != TURNED_UP), *told)
        for note in notes:
            errors.print(f"note: {note}", highlight=False, soft_wrap=True)
        losses = {"points": {"declared": cloud.points_declared, "dropped": dict(cloud.dropped) | found.dropped}}
        summary = {"name": file.name} | summarise_cloud(snapshot, losses, __version__, notes) | oriented
        rescan = np.zeros(len(snapshot), dtype=np.bool_)
        if density is not None:
            rescan = (snapshot.density_per_mm2 < density) & (snapshot.unreliable != Unreliable.NOT_COUNTED)
            summary["below_required"] = int(rescan.sum())
        write_points_ply(out / "points.ply", snapshot, rescan, version=__version__, normals_by=BY_ANALYSIS)
        drawing = importlib.import_module("scanner_service.storage.exports.density_png")  # 40 MB that no method needs
        required = math.nan if density is None else density
        write_whole(
            out / "density.png",
            drawing.density_png(snapshot, session_name=file.name, required_per_mm2=required),
        )
        write_json(out / "regions.json", {"regions": [], "notes": [NO_REGIONS]})
        write_json(out / "summary.json", summary)
        if as_json:
            show_json(summary)
            return
        console.print(
            f"{len(snapshot):,} points, radius {summary['radius_mm']['median']:.3f} mm, density "
            f"{summary['density_per_mm2']['median']:.2f} points/mm², {summary['reliable_share']:.1%} with a reliable "
            "normal" + (f"; {summary['below_required']:,} below {density:g} points/mm²" if density is not None else ""),
            highlight=False,
        )
        files = "points.ply, density.png, regions.json, summary.json" + (", oriented.ply" if orient else "")
        console.print(f"Written to {out}: {files}", highlight=False)


def _rule(rule: str | None, radius: float | None) -> CloudRule:
    """The rule asked for; a radius alone means `fixed`, nothing means `global`."""
    if rule is None:
        return "fixed" if radius is not None else "global"
    if rule == "fixed" and radius is None:
        raise ValueError("the rule `fixed` needs a radius: say --radius R in mm")
    if rule != "fixed" and radius is not None:
        raise ValueError(f"a radius is given and the rule is {rule}: leave one of them out")
    for known in get_args(CloudRule):
        if rule == known:
            return cast(CloudRule, known)
    raise ValueError(f"the rule must be fixed, flexible or global, not {rule}")
