"""Recorded scans in the service's replay folder: which there are, bringing one, removing one; plays none."""

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from scanner_service.api.answers import answer
from scanner_service.api.routes.sessions import operator, viewer
from scanner_service.sessions.file_shelf import FileShelf, ShelfFile

router = APIRouter(prefix="/api/v1/files", tags=["files"])


def shelf_of(request: Request) -> FileShelf:
    """The service's folder of recorded scans."""
    shelf: FileShelf = request.app.state.service.shelf
    return shelf


Shelf = Annotated[FileShelf, Depends(shelf_of)]


def file_answer(file: ShelfFile) -> dict[str, Any]:
    """What there is to say of a file."""
    return {"name": file.name, "bytes": file.size_bytes, "kind": file.kind}


@router.get("", dependencies=[viewer])
def list_files(shelf: Shelf) -> Response:
    """The recorded scans that can be played, by name; `kind` is null for what is none of the kinds that are read."""
    return answer({"files": [file_answer(file) for file in shelf.files()]})


@router.put("/{name}", status_code=201, dependencies=[operator])
async def put_file(request: Request, shelf: Shelf, name: str) -> Response:
    """Bring a file, its bytes as the body: a record, or a scan in one of the formats that are read. At most 2 GiB.

    It is there when it is whole and was looked at. The same file again is answered as at first; another one of the
    same name is refused.
    """
    declared = request.headers.get("content-length", "")
    arrival = await run_in_threadpool(shelf.receive, name, int(declared) if declared.isdigit() else None)
    with arrival:
        async for piece in request.stream():
            await run_in_threadpool(arrival.write, piece)
        kept = await run_in_threadpool(arrival.keep)
    return answer(file_answer(kept), 201, {"Location": f"/api/v1/files/{name}"})


@router.delete("/{name}", status_code=204, dependencies=[operator])
def delete_file(shelf: Shelf, name: str) -> Response:
    """Remove a file; the sessions that were made from it stay."""
    shelf.remove(name)
    return Response(status_code=204)
