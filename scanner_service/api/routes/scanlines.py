"""Scanlines in and out: pushed lines are answered when they are durable, stored lines are read in ranges."""

import asyncio
from concurrent.futures import Future
from typing import Annotated

from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from scanner_service.analysis.intake import QUANTUM_MM, StoredLine
from scanner_service.api.answers import answer
from scanner_service.api.routes.sessions import Session, book_of, operator, viewer
from scanner_service.api.schemas import ScanlinesIn
from scanner_service.storage.rows import DamagedLine, Stored

router = APIRouter(prefix="/api/v1/sessions/{session_id}/scanlines", tags=["scanlines"])


@router.post("", dependencies=[operator])
async def push_scanlines(session: Session, body: ScanlinesIn) -> Response:
    """Hand over scanlines. The answer comes when every line's commit has returned, with one outcome a line.

    Pushing the same lines again is safe: they are answered as `duplicate`. The status is 409 when a line of them is not
    stored: refused, or in conflict with another line of its index.
    """

    def push() -> "list[Future[Stored]]":
        return [session.push(line.to_scanline()) for line in body.lines]

    futures = await run_in_threadpool(push)
    outcomes = await asyncio.gather(*(asyncio.wrap_future(future) for future in futures), return_exceptions=True)
    results = [
        {"line_index": line.line_index, "outcome": outcome.outcome, "line_number": outcome.line_number}
        if isinstance(outcome, Stored)
        else {"line_index": line.line_index, "outcome": "refused", "detail": str(outcome)}
        for line, outcome in zip(body.lines, outcomes, strict=True)
    ]
    is_stored = all(isinstance(outcome, Stored) and outcome.outcome != "conflict" for outcome in outcomes)
    return answer({"lines": results}, 200 if is_stored else 409)


@router.get("", dependencies=[viewer])
def read_scanlines(
    request: Request,
    session_id: str,
    start: Annotated[int, Query(ge=0)] = 0,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
) -> Response:
    """Stored scanlines from number `start` on, exactly as they were quantised."""
    record = book_of(request).record
    row = record.get_session(session_id)
    damaged: list[DamagedLine] = []
    found = [
        _line_answer(number, line, row.origin_mm)
        for number, line in record.lines(session_id, start, start + limit, on_damage=damaged.append)
    ]
    is_full = len(found) + len(damaged) == limit
    return answer({"scanlines": found, "damaged": damaged, "next": start + limit if is_full else None})


def _line_answer(number: int, line: StoredLine, origin_mm: tuple[float, float, float]) -> dict[str, object]:
    return {
        "line_number": number,
        "device_id": line.device_id,
        "boot_id": line.boot_id,
        "pass_index": line.pass_index,
        "line_index": line.line_index,
        "device_time_s": line.device_time_s,
        "index": line.index,
        "points_mm": line.xyz_q * QUANTUM_MM + origin_mm,
        "point_count": line.point_count,
        "dropped": line.dropped,
        "laser_mm": line.laser_mm,
        "plane_normal": line.plane_normal,
        "travel": line.travel,
        "position_mm": line.position_mm,
        "line_spacing_mm": line.line_spacing_mm,
        "step_mm": line.step_mm,
    }
