"""A small application with every kind of route, behind the real guard on a real server: what these tests speak to."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from typing import Annotated, Any

import httpx
from fastapi import APIRouter, Depends, FastAPI, Request, WebSocket
from pydantic import BaseModel, ConfigDict, FiniteFloat
from starlette.responses import PlainTextResponse

from scanner_service.api.access import ACCESS_PROBLEMS, Access, Identity
from scanner_service.api.docs_page import install_docs
from scanner_service.api.guard import Guard, GuardRules
from scanner_service.api.keys import Role
from scanner_service.api.login import login_router
from scanner_service.api.problems import Problem, register_problems
from scanner_service.api.scopes import (
    Scoped,
    accepted_subprotocol,
    check_every_route_declares_a_scope,
    public,
    require,
)
from scanner_service.api.server import Listening, ServerLimits, ServerThread


class Clock:
    """A clock that tests set."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


class StageBlocked(Exception):
    """An error of an application's own."""


class Line(BaseModel):
    model_config = ConfigDict(extra="forbid")
    line_spacing_mm: FiniteFloat
    points: list[float] = []


def small_app(data_dir: Path, clock: Clock | None = None) -> FastAPI:
    """Routes of every role and kind; `app.state.access` has repeatable keys."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    app.state.access = Access.open(data_dir, clock or Clock(), Random(1).randbytes)
    table = {**ACCESS_PROBLEMS, StageBlocked: Problem(409, "stage-blocked", "The stage is blocked")}
    register_problems(app, table)
    router = APIRouter(prefix="/api/v1")

    @router.get("/lines", dependencies=[Depends(require(Role.VIEWER))])
    async def lines() -> dict[str, int]:
        return {"lines": 3}

    @router.post("/lines")
    async def push(line: Line, who: Annotated[Identity, Depends(require(Role.OPERATOR))]) -> dict[str, Any]:
        return {"by": who.label, "line_spacing_mm": line.line_spacing_mm}

    @router.delete("/lines", dependencies=[Depends(require(Role.ADMIN))])
    async def forget() -> dict[str, int]:
        return {"lines": 0}

    @router.post("/raw", dependencies=[Depends(public)])
    @router.post("/bulk/raw", dependencies=[Depends(public)])
    async def raw(request: Request) -> dict[str, int]:
        return {"bytes": sum([len(part) async for part in request.stream()])}

    @router.get("/blocked", dependencies=[Depends(public)])
    async def blocked() -> None:
        raise StageBlocked("The stage stands against its end switch; move it back by hand.")

    @router.get("/broken", dependencies=[Depends(public)])
    async def broken() -> None:
        raise RuntimeError("secret of the house")

    @router.get("/large", dependencies=[Depends(public)])
    async def large() -> PlainTextResponse:
        return PlainTextResponse("x" * 32_000_000)

    @router.websocket("/live")
    async def live(websocket: WebSocket, who: Annotated[Identity, Depends(require(Role.VIEWER))]) -> None:
        await websocket.accept(accepted_subprotocol(websocket))
        await websocket.send_text(f"{who.role.name} {who.means}")
        await websocket.close()

    @router.websocket("/flood")
    async def flood(websocket: WebSocket, who: Annotated[Identity, Depends(require(Role.VIEWER))]) -> None:
        await websocket.accept()
        while True:
            await websocket.send_bytes(bytes(100_000))

    async def files(scope: Any, receive: Any, send: Any) -> None:
        await PlainTextResponse("a file")(scope, receive, send)

    app.include_router(router)
    app.include_router(login_router())
    app.mount("/open", Scoped(files, public))
    app.mount("/kept", Scoped(files, require(Role.OPERATOR)))
    install_docs(app, table.values())
    check_every_route_declares_a_scope(app)
    return app


@contextmanager
def served(app: Any, rules: GuardRules | None = None, limits: ServerLimits | None = None) -> Iterator[Listening]:
    """The application behind the guard on a free port."""
    with ServerThread(Guard(app, rules or GuardRules()), limits=limits) as listening:
        yield listening


@contextmanager
def client(listening: Listening, key: str | None = None, **headers: str) -> Iterator[httpx.Client]:
    if key is not None:
        headers["Authorization"] = f"Bearer {key}"
    with httpx.Client(base_url=listening.url, headers=headers, trust_env=False, timeout=30) as http:
        yield http


def raw_exchange(listening: Listening, request: bytes) -> bytes:
    """Send bytes, and read until the server ends the connection."""
    with socket.create_connection((listening.host, listening.port), timeout=30) as connection:
        connection.sendall(request)
        answer = b""
        while part := connection.recv(65536):
            answer += part
        return answer
