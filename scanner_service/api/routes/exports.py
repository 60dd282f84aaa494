"""Exports of a session: which formats there are, ordering one, how far it is, and its files."""

from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import FileResponse, Response

from scanner_service.api.answers import answer
from scanner_service.api.errors import ExportUnknown
from scanner_service.api.routes.sessions import operator, viewer
from scanner_service.sessions.errors import SourceUnusable
from scanner_service.sessions.export_desk import ExportDesk, ExportJob
from scanner_service.sessions.exporting import FORMATS, RECORD, REPORT, RESULTS, missing_for
from scanner_service.storage.exports.point_files import POINT_FORMATS

router = APIRouter(prefix="/api/v1/sessions/{session_id}/exports", tags=["exports"])
MEDIA_TYPES = {".html": "text/html; charset=utf-8", ".pdf": "application/pdf", ".json": "application/json"} | {
    f".{one.name}": one.media_type for one in POINT_FORMATS.values()
}
WHAT = {name: one.what for name, one in POINT_FORMATS.items()} | {
    RESULTS: "density map, rescan regions and summary",
    RECORD: "the session as a record of its own, to be replayed elsewhere",
    REPORT: "report as HTML and PDF",
}


class ExportIn(BaseModel):
    """What to write."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    formats: Annotated[
        list[Annotated[str, Field(max_length=20)]],
        Field(min_length=1, max_length=len(FORMATS) + 1, examples=[["laz", "report"]]),
    ]


def desk_of(request: Request) -> ExportDesk:
    """The service's desk for exports."""
    desk: ExportDesk = request.app.state.service.exports
    return desk


Desk = Annotated[ExportDesk, Depends(desk_of)]


def job_answer(job: ExportJob) -> dict[str, Any]:
    """All that there is to say of an export."""
    base = f"/api/v1/sessions/{job.session_id}/exports/{job.job_id}"
    said = {} if job.manifest is None else job.manifest["files"]
    return {
        "id": job.job_id,
        "session": job.session_id,
        "formats": job.formats,
        "state": job.state,
        "doing": job.doing,
        "share": job.share,
        "failure": job.failure,
        "left_out": {} if job.manifest is None else job.manifest["left_out"],
        "files": [{"name": name, "url": f"{base}/files/{name}", **said.get(name, {})} for name in job.files],
    }


def job_of(desk: ExportDesk, session_id: str, export_id: str) -> ExportJob:
    """The export; raises ExportUnknown."""
    try:
        return desk.job(session_id, export_id)
    except SourceUnusable as error:
        raise ExportUnknown(str(error)) from None


@router.get("", dependencies=[viewer])
def list_exports(desk: Desk, session_id: str) -> Response:
    """The formats that can be written here, and the exports of the session that are kept."""
    formats = [
        {"name": name, "what": WHAT[name], "available": (missing := missing_for(name)) is None, "why_not": missing}
        for name in FORMATS
    ]
    return answer({"formats": formats, "exports": [job_answer(job) for job in desk.jobs(session_id)]})


@router.post("", status_code=202, dependencies=[operator])
def order_export(desk: Desk, session_id: str, body: ExportIn) -> Response:
    """Have the session written in the formats named, `all` for every one that can be written here.

    It is written while you ask how far it is; what `all` left out is told under `left_out`, with the reason.
    """
    job = desk.order(session_id, body.formats)
    return answer(job_answer(job), 202, {"Location": f"/api/v1/sessions/{session_id}/exports/{job.job_id}"})


@router.get("/{export_id}", dependencies=[viewer])
def get_export(desk: Desk, session_id: str, export_id: str) -> Response:
    """How far an export is, and its files when it is done."""
    return answer(job_answer(job_of(desk, session_id, export_id)))


@router.get("/{export_id}/files/{file_name}", dependencies=[viewer])
def get_export_file(desk: Desk, session_id: str, export_id: str, file_name: str) -> Response:
    """One file of an export, to be saved."""
    try:
        path = desk.file(session_id, export_id, file_name)
    except SourceUnusable as error:
        raise ExportUnknown(str(error)) from None
    media_type = MEDIA_TYPES.get(Path(file_name).suffix, "application/octet-stream")
    return FileResponse(path, media_type=media_type, filename=f"{session_id}-{file_name}")


@router.delete("/{export_id}", status_code=204, dependencies=[operator])
def take_back_export(desk: Desk, session_id: str, export_id: str) -> Response:
    """Forget an export and remove its files, written or not; the session stays."""
    job_of(desk, session_id, export_id)
    desk.take_back(session_id, export_id)
    return Response(status_code=204)
