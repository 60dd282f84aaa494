"""What a session found out: points, density map, rescan regions, summary and the files to take away."""

import math
import shutil
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Query
from starlette.responses import FileResponse, Response
from starlette.types import Receive, Scope, Send

from scanner_service.analysis.expected import expected_density_per_mm2, expected_neighbours, surface_spacing_mm
from scanner_service.analysis.snapshot import RadiusRule, Unreliable
from scanner_service.api.answers import answer
from scanner_service.api.errors import ExportUnknown, ValueUnusable
from scanner_service.api.routes.sessions import Session, viewer
from scanner_service.rescan.judgement import Reason
from scanner_service.sessions.outputs import OUTPUT_FILES, outcome_of, summary_of, write_output
from scanner_service.sessions.results import Results
from scanner_service.sessions.session import LiveSession

router = APIRouter(prefix="/api/v1/sessions/{session_id}", tags=["results"], dependencies=[viewer])
MEDIA_TYPES = {".ply": "application/octet-stream", ".png": "image/png", ".json": "application/json"}


def results_of(session: LiveSession) -> Results:
    """The verdict on a scan that is over; on one that runs, the latest, or a first one made now."""
    return session.results() or session.fresh_results()


@router.get("/points")
def list_points(
    session: Session,
    start: Annotated[int, Query(ge=0)] = 0,
    limit: Annotated[int, Query(ge=1, le=10_000)] = 1000,
) -> Response:
    """Points from row `start` on, as arrays of equal length; what is not known is null."""
    results = results_of(session)
    points, verdict = results.snapshot, results.verdict
    part = slice(start, start + limit)
    rows = np.arange(len(points), dtype=np.int32)[part]
    along_mm = points.lines.point_spacing_mm[points.line[part]]
    across_mm = surface_spacing_mm(points, rows, 20.0 * session.settings.uncertainty_mm)
    return answer(
        {
            "version": points.version,
            "total": len(points),
            "start": start,
            "points_mm": points.points_mm[part],
            "scanline": points.line[part],
            "radius_mm": points.radius_mm[part],
            "radius_rule": [RadiusRule(rule).name.lower() for rule in points.radius_rule[part]],
            "neighbours": points.neighbours[part],
            "density_per_mm2": points.density_per_mm2[part],
            "side_density_per_mm2": points.side_density_per_mm2[part],
            "surface_spacing_mm": across_mm,
            "expected_density_per_mm2": expected_density_per_mm2(across_mm, along_mm),
            "expected_neighbours": expected_neighbours(points.radius_mm[part], across_mm, along_mm),
            "normal_error_rad": points.normal_error_rad[part],
            "normals": points.normals[part],
            "unreliable": [Unreliable(reason).name.lower() for reason in points.unreliable[part]],
            "settled": points.settled[part],
            "isolated": points.isolated[part],
            "rescan": verdict.rescan[part],
            "reason": [Reason(reason).label for reason in verdict.reason[part]],
            "next": start + limit if start + limit < len(points) else None,
        }
    )


@router.get("/density-map")
def density_map(session: Session) -> Response:
    """The cells of the density map, and the observed coverage."""
    return answer(results_of(session).coverage.to_dict())


@router.get("/density-map.png")
def density_map_picture(
    session: Session,
    along_x: Annotated[float, Query(allow_inf_nan=False)] = 0.0,
    along_y: Annotated[float, Query(allow_inf_nan=False)] = 0.0,
    along_z: Annotated[float, Query(allow_inf_nan=False)] = -1.0,
) -> Response:
    """The density map as a picture, seen along the direction given (from above by default)."""
    from scanner_service.storage.exports.density_png import density_png  # noqa: PLC0415 - 0.4 s for who draws nothing

    direction = np.array([along_x, along_y, along_z])
    if not math.isclose(float(np.linalg.norm(direction)), 1.0, abs_tol=1e-3):
        raise ValueUnusable("along_x, along_y and along_z must be the parts of a direction of length 1")
    results = results_of(session)
    picture = density_png(
        results.snapshot,
        results.regions,
        session_name=session.row.name,
        coverage=results.share,
        direction=direction,
    )
    return Response(picture, media_type="image/png")


@router.get("/regions")
def list_regions(session: Session) -> Response:
    """The rescan regions, most urgent first, each with its id, status and history; and those that were resolved."""
    results = results_of(session)
    return answer({"version": results.snapshot.version, **results.regions_dict()})


@router.get("/coverage")
def get_coverage(session: Session) -> Response:
    """Coverage asked for and reached: of the surface seen, and of the nominal part where there is one."""
    results = results_of(session)
    return answer({"version": results.snapshot.version, **results.coverage_dict()})


@router.get("/summary")
def get_summary(session: Session) -> Response:
    """What summary.json holds."""
    return answer(summary_of(outcome_of(session, results_of(session))))


@router.get("/export/{file_name}")
def export(session: Session, file_name: str) -> Response:
    """One of the files points.ply, density.png, regions.json, summary.json."""
    if file_name not in OUTPUT_FILES:
        raise ExportUnknown(f"there is no export {file_name}; ask for one of {', '.join(OUTPUT_FILES)}")
    folder = Path(tempfile.mkdtemp(prefix="scanner-export-"))
    try:
        write_output(file_name, folder / file_name, outcome_of(session, results_of(session)))
    except BaseException:
        shutil.rmtree(folder)
        raise
    return PassingFile(
        folder / file_name,
        media_type=MEDIA_TYPES[Path(file_name).suffix],
        filename=f"{session.row.session_id}-{file_name}",
    )


class PassingFile(FileResponse):
    """A file whose folder is removed after the answer, whatever that was: a background task is not run for each."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            shutil.rmtree(Path(self.path).parent, ignore_errors=True)
