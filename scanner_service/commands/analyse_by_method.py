"""`scanner analyse --method`: one of the other methods on a cloud, its values as a PLY and a summary."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from scanner_service import __version__
from scanner_service.analysis.comparison.scoring import score
from scanner_service.analysis.comparison.shapes import known_cloud
from scanner_service.analysis.errors import AnalysisError
from scanner_service.analysis.method_analysis import MethodAnswer, analyse_by_method, summarise_answer
from scanner_service.analysis.normals.field import NormalOptions
from scanner_service.commands.clouds import OpenedCloud
from scanner_service.commands.compiling_apart import compile_apart
from scanner_service.commands.terminal import check_folder, console, errors, show_json
from scanner_service.storage.exports.method_ply import write_method_ply
from scanner_service.storage.exports.results_json import write_json
from scanner_service.storage.formats.normals_of import NormalsOf


def analyse_file_by_method(
    cloud: OpenedCloud,
    method: str,
    options: NormalOptions,
    seen_from_mm: tuple[float, float, float] | None,
    out: Path,
    as_json: bool,
    orient: bool = False,
) -> None:
    """Run the method, and write `points.ply` and `summary.json`; with `orient` its normals are turned to one side.

    Raises
    ------
    AnalysisError, ValueError, ExportError : with one plain sentence.
    """
    if seen_from_mm is not None and not np.isfinite(seen_from_mm).all():
        raise ValueError("the place that normals are turned to needs three numbers: say --seen-from x,y,z")
    check_folder(out)
    towards = cloud.laser_mm if seen_from_mm is None else np.array(seen_from_mm)
    compile_apart(method, len(cloud.points_mm))
    with errors.status(f"{method} on {len(cloud.points_mm):,} points …"):
        answer = analyse_by_method(cloud.points_mm, method, options, towards_mm=towards, orient=orient)
    notes = (*cloud.notes, *answer.notes)
    for note in notes:
        errors.print(f"note: {note}", highlight=False, soft_wrap=True)
    summary = {
        "name": cloud.name,
        "version": __version__,
        **summarise_answer(answer),
        "notes": list(notes),
        "losses": {"points": {"declared": cloud.points_declared, "dropped": cloud.dropped}},
        "against_reference": _against(cloud, answer),
    }
    write_method_ply(out / "points.ply", cloud.points_mm, answer)
    write_json(out / "summary.json", summary)
    if as_json:
        show_json(summary)
        return
    given = int((answer.reason == 0).sum())
    lost = ", ".join(f"{count:,} {name}" for name, count in answer.counts.items() if count and name != "given")
    console.print(
        f"{given:,} of {len(answer):,} points have a normal by {method}" + (f"; without: {lost}" if lost else ""),
        highlight=False,
    )
    reference = summary["against_reference"]
    if isinstance(reference, dict):
        whose = _WHOSE[cloud.normals_of]
        console.print(
            f"against {whose}: rms {reference['rms_deg']:.2f}°, median {reference['median_deg']:.2f}°, "
            f"within 5° {reference['within_5_deg']:.1%}",
            highlight=False,
        )
    console.print(f"Written to {out}: points.ply, summary.json", highlight=False, soft_wrap=True)


_WHOSE: dict[NormalsOf, str] = {
    "file": "the file's own normals",
    "live map": "the live map's normals, an estimate too",
    "scanner analyse": "the normals of an earlier analysis, an estimate too",
}


def refuse(options: Mapping[str, object], why: str) -> None:
    """Refuse options that would be without effect; raises ValueError."""
    given = [f"--{name}" for name, value in options.items() if value is not None]
    if given:
        raise ValueError(f"{', '.join(given)}: {why}")


def _against(cloud: OpenedCloud, answer: MethodAnswer) -> dict[str, float] | None:
    """Errors in degrees against the normals that the file itself has, regardless of sign; None when it has none."""
    if cloud.normals is None:
        return None
    try:
        reference, kept = known_cloud(cloud.name, cloud.points_mm, cloud.normals)
    except AnalysisError:
        return None
    found = score(answer.normals[kept], reference.normals)
    return {
        "rms_deg": math.degrees(found.rms_rad),
        "median_deg": math.degrees(found.median_rad),
        "within_5_deg": found.within_5_deg,
        "within_10_deg": found.within_10_deg,
        "missing": found.missing,
    }
