"""Which role each route needs; a route that does not say so keeps the service from starting.

@router.post("/sessions", dependencies=[Depends(require(Role.OPERATOR))])
async def create(who: Annotated[Identity, Depends(require(Role.OPERATOR))]) -> ...   # the same, and who asks
@router.get("/healthz", dependencies=[Depends(public)])
app.mount("/static", Scoped(StaticFiles(...), public))
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

from fastapi import APIRouter, FastAPI
from fastapi.dependencies.models import Dependant
from fastapi.routing import RouteContext, iter_route_contexts
from starlette.requests import HTTPConnection, Request
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket

from scanner_service.api.access import Access, Identity
from scanner_service.api.keys import Role

LIVE_SUBPROTOCOL = "scanner.v1"


class ScopeUndeclared(Exception):
    """A route does not say who may use it, or says two things; the message lists every such route."""


@dataclass(frozen=True, slots=True)
class Requirement:
    """The least role of a route, as a FastAPI dependency that gives the identity; None: open to everyone.

    Works for requests and, before they are accepted, for WebSockets. The application keeps its `Access` in
    `app.state.access`.
    """

    role: Role | None

    async def __call__(self, connection: HTTPConnection) -> Identity | None:
        """Who asks; None on a public route.

        Raises
        ------
        NotAuthenticated, or one of its kinds; RoleTooLow
        """
        if self.role is None:
            return None
        access: Access = connection.app.state.access
        identity = access.identify(connection)
        access.authorise(identity, self.role)
        connection.state.identity = identity
        return identity


@cache
def require(role: Role) -> Requirement:
    """The requirement of at least `role`."""
    return Requirement(role)


public = Requirement(None)


class Scoped:
    """A mounted ASGI application with the role it needs; mounts cannot have FastAPI dependencies."""

    def __init__(self, app: ASGIApp, requirement: Requirement) -> None:
        self.app = app
        self.requirement = requirement

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on when the requirement is met."""
        if scope["type"] == "http":
            await self.requirement(Request(scope))
        elif scope["type"] == "websocket":
            await self.requirement(WebSocket(scope, receive, send))
        await self.app(scope, receive, send)


@dataclass(frozen=True, slots=True)
class DeclaredRoute:
    """One row of the route table; `methods` is empty for WebSockets and mounts."""

    kind: str
    path: str
    methods: frozenset[str]
    role: Role | None

    def __str__(self) -> str:
        role = self.role.name.lower() if self.role else "public"
        return f"{'/'.join(sorted(self.methods)) or self.kind} {self.path}: {role}"


def route_table(app: FastAPI) -> list[DeclaredRoute]:
    """Every route with the role it needs; the strictest one where several are declared.

    Raises
    ------
    ScopeUndeclared : when any route, WebSocket or mount has none, or is both public and not.
    """
    table, faults = [], []
    for route in iter_route_contexts(app.routes):
        found = set(_requirements(route))
        path = route.path or type(route.original_route).__name__
        if not found:
            faults.append(f"{path} declares no scope")
        elif public in found and len(found) > 1:
            faults.append(f"{path} is declared public and also needs a role")
        else:
            role = max((item.role for item in found if item.role), default=None)
            kind = type(route.original_route).__name__.removeprefix("API").removesuffix("Route") or "Route"
            table.append(DeclaredRoute(kind, path, frozenset(getattr(route, "methods", None) or ()), role))
    faults += [f"{path} is a frontend route; mount the files with Scoped(...) instead" for path in _hidden(app.router)]
    if faults:
        raise ScopeUndeclared("The service does not start: " + "; ".join(faults) + ".")
    return table


def check_every_route_declares_a_scope(app: FastAPI) -> None:
    """To be called when all routes are there, before the application is served.

    Raises
    ------
    ScopeUndeclared : naming every route that does not say who may use it.
    """
    route_table(app)


def accepted_subprotocol(websocket: WebSocket) -> str | None:
    """The subprotocol to accept a WebSocket with: ours when offered, never the one that carries the key."""
    return LIVE_SUBPROTOCOL if LIVE_SUBPROTOCOL in websocket.scope.get("subprotocols", ()) else None


def _requirements(route: RouteContext) -> Iterator[Requirement]:
    mounted = getattr(route, "app", None)
    if isinstance(mounted, Scoped):
        yield mounted.requirement
    dependant = getattr(route, "dependant", None)
    if isinstance(dependant, Dependant):
        yield from _calls(dependant)


def _calls(dependant: Dependant) -> Iterator[Requirement]:
    for dependency in dependant.dependencies:
        if isinstance(dependency.call, Requirement):
            yield dependency.call
        yield from _calls(dependency)


def _hidden(router: Any) -> Iterator[str]:
    """Routes that FastAPI keeps beside the route table, in this router and in those it includes."""
    for route in getattr(router, "_low_priority_routes", ()):
        yield str(getattr(route, "path", type(route).__name__))
    for route in router.routes:
        included = getattr(route, "original_router", None)
        if isinstance(included, APIRouter):
            yield from _hidden(included)
