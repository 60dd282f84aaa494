"""Whether the service lives, is ready, and what it counted; knows no session's insides."""

from dataclasses import asdict

from fastapi import APIRouter, Depends, Request
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest
from starlette.responses import Response

from scanner_service import __version__
from scanner_service.api.answers import answer
from scanner_service.api.keys import Role
from scanner_service.api.scopes import public, require

router = APIRouter(tags=["service"])


@router.get("/healthz", dependencies=[Depends(public)])
async def healthz() -> Response:
    """The process answers."""
    return answer({"status": "ok"})


@router.get("/readyz", dependencies=[Depends(public)])
async def readyz(request: Request) -> Response:
    """Ready when the kernels are compiled and the record takes lines; 503 until then.

    `preparing` says what is being loaded, or compiled (`compiles`): `what`, `step` of how many (`of`), and since how
    many `seconds`.
    """
    service = request.app.state.service
    checks = {"kernels": service.kernels_ready, "record": service.book.record.writer_state().state == "ok"}
    is_ready = all(checks.values())
    told = None if service.preparing is None else asdict(service.preparing)
    found = {"status": "ready" if is_ready else "not ready", "checks": checks, "preparing": told}
    return answer(found, 200 if is_ready else 503)


@router.get("/version", dependencies=[Depends(public)])
async def version() -> Response:
    """The version of the service."""
    return answer({"version": __version__})


@router.get("/metrics", dependencies=[Depends(require(Role.VIEWER))])
async def metrics(request: Request) -> Response:
    """Counters in the Prometheus text format."""
    return Response(generate_latest(request.app.state.service.metrics), media_type=CONTENT_TYPE_LATEST)
