"""Analyses by the methods for clouds without scanlines: begin one, watch it, take its result; computes nothing."""

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from scanner_service.analysis.errors import MethodUnknown
from scanner_service.analysis.method_analysis import METHOD_NAMES, check_options, summarise_answer
from scanner_service.api.answers import answer
from scanner_service.api.errors import ValueUnusable
from scanner_service.api.routes.results import PassingFile
from scanner_service.api.routes.sessions import book_of, operator, viewer
from scanner_service.api.schemas import AnalysisIn, FilePointsIn, SessionPointsIn
from scanner_service.sessions.analyses import MAX_POINTS, AnalysisBook, AnalysisJob, AnalysisPoints, AnalysisRequest
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.errors import SourceUnusable
from scanner_service.storage.exports.method_ply import write_method_ply
from scanner_service.storage.formats import ReadOptions, open_cloud

router = APIRouter(prefix="/api/v1/analyses", tags=["analyses"])
MAX_FILE_BYTES = 1 << 29


def analyses_of(request: Request) -> AnalysisBook:
    """The service's analyses."""
    analyses: AnalysisBook = request.app.state.service.analyses
    return analyses


def job_answer(job: AnalysisJob) -> dict[str, Any]:
    """What there is to say of an analysis before it has a result."""
    return {
        "id": job.job_id,
        "method": job.method,
        "source": job.source,
        "created": job.created_utc,
        "state": job.state,
        "progress": job.progress,
        "points": job.points,
        "message": job.message,
        "notes": job.notes,
    }


@router.post("", status_code=202, dependencies=[operator])
def begin_analysis(request: Request, body: AnalysisIn) -> Response:
    """Begin an analysis. It is answered at once with its id; the address in `Location` tells how far it is."""
    if body.method not in METHOD_NAMES:
        raise MethodUnknown(f"there is no such method; the methods are {', '.join(METHOD_NAMES)}")
    try:
        options = body.options.to_options()
    except ValueError as error:
        raise ValueUnusable(str(error)) from None
    check_options(body.method, options)
    if body.orient and isinstance(body.source, FilePointsIn) and body.source.seen_from_mm is not None:
        raise ValueUnusable("seen_from_mm tells the side of each normal, orient finds it: leave one of them out")
    service = request.app.state.service
    source = body.source
    wanted = (
        _session_points(book_of(request), source, body.orient)
        if isinstance(source, SessionPointsIn)
        else _file_points(service.replay_dir, source)
    )
    named: dict[str, str] = {"kind": source.kind}
    named |= {"session_id": source.session_id} if isinstance(source, SessionPointsIn) else {"file": source.file}
    job = analyses_of(request).begin(AnalysisRequest(body.method, options, named, wanted, body.orient))
    return answer(job_answer(job), 202, {"Location": f"/api/v1/analyses/{job.job_id}"})


@router.get("", dependencies=[viewer])
def list_analyses(request: Request) -> Response:
    """The analyses that are known, newest first; few enough for one answer."""
    return answer({"methods": METHOD_NAMES, "analyses": [job_answer(job) for job in analyses_of(request).jobs()]})


@router.get("/{analysis_id}", dependencies=[viewer])
def get_analysis(request: Request, analysis_id: str) -> Response:
    """How far an analysis is; when it is done, a summary of its result."""
    analyses = analyses_of(request)
    job = analyses.get(analysis_id)
    summary = summarise_answer(analyses.result(analysis_id).answer) if job.state == "done" else None
    return answer({**job_answer(job), "summary": summary})


@router.get("/{analysis_id}/points", dependencies=[viewer])
def list_analysis_points(
    request: Request,
    analysis_id: str,
    start: Annotated[int, Query(ge=0)] = 0,
    limit: Annotated[int, Query(ge=1, le=10_000)] = 1000,
) -> Response:
    """Points from row `start` on with what the method says of them, as arrays of equal length; unknown is null."""
    result = analyses_of(request).result(analysis_id)
    found, part = result.answer, slice(start, start + limit)
    total = len(found)
    return answer(
        {
            "total": total,
            "start": start,
            "points_mm": result.points_mm[part],
            "normals": found.normals[part],
            "reason": [found.reasons[number] for number in found.reason[part]],
            "neighbours": found.neighbours[part],
            **{name: values[part] for name, values in (*found.scalars.items(), *found.vectors.items())},
            "next": start + limit if start + limit < total else None,
        }
    )


@router.get("/{analysis_id}/points.ply", dependencies=[viewer])
async def export_analysis(request: Request, analysis_id: str) -> Response:
    """The whole result as a PLY."""
    result = analyses_of(request).result(analysis_id)
    folder = Path(await run_in_threadpool(tempfile.mkdtemp, prefix="scanner-export-"))
    try:
        await run_in_threadpool(write_method_ply, folder / "points.ply", result.points_mm, result.answer)
    except BaseException:
        shutil.rmtree(folder)
        raise
    return PassingFile(
        folder / "points.ply", media_type="application/octet-stream", filename=f"{analysis_id}-points.ply"
    )


@router.delete("/{analysis_id}", status_code=204, dependencies=[operator])
def forget_analysis(request: Request, analysis_id: str) -> Response:
    """Drop an analysis and its result; one that runs ends at its next step."""
    analyses_of(request).forget(analysis_id)
    return Response(status_code=204)


def _session_points(book: SessionBook, source: SessionPointsIn, orient: bool) -> Callable[[], AnalysisPoints]:
    """A function that reads the points of a session as they are when the analysis begins; raises SessionUnknown."""
    book.record.get_session(source.session_id)

    def read() -> AnalysisPoints:
        session = book.get(source.session_id)
        if session.engine.ledger.counted > MAX_POINTS:
            raise ValueError(f"the session holds more than {MAX_POINTS:,} points: export it, and analyse a part")
        snapshot = session.engine.ask(lambda engine: engine.live_map.snapshot()).result()
        whither = "over a graph, although each has a laser" if orient else "to the laser of each point's own scanline"
        note = f"session {source.session_id}: normals are turned {whither}"
        return AnalysisPoints(snapshot.points_mm, snapshot.lines.laser_mm[snapshot.line], (note,))

    return read


def _file_points(folder: Path, source: FilePointsIn) -> Callable[[], AnalysisPoints]:
    """A function that reads a cloud of the replay folder; raises SourceUnusable when there is none of that name."""
    if source.file not in {item.name for item in folder.iterdir()}:
        raise SourceUnusable(f"there is no file {source.file} in the service's replay folder")
    towards = None if source.seen_from_mm is None else np.array(source.seen_from_mm)

    def read() -> AnalysisPoints:
        cloud = open_cloud(folder / source.file, ReadOptions(units=source.units, max_bytes=MAX_FILE_BYTES))
        lost = tuple(f"{count} points are left out: {reason}" for reason, count in cloud.dropped.items())
        return AnalysisPoints(cloud.points_mm, towards, (*cloud.notes, *lost))

    return read
