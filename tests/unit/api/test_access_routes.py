"""Who gets through which route: the matrix is made from the route table, over real connections."""

import asyncio
from collections.abc import Iterator
from dataclasses import dataclass
from http.cookies import SimpleCookie
from pathlib import Path
from random import Random
from typing import Annotated, Any

import httpx
import pytest
import websockets.sync.client as ws_client
from fastapi import APIRouter, Depends, FastAPI, WebSocket
from starlette.responses import PlainTextResponse
from websockets.exceptions import InvalidStatus
from websockets.typing import Subprotocol

from scanner_service.api.access import Access, Identity
from scanner_service.api.keys import Role, make_key
from scanner_service.api.login import login_url
from scanner_service.api.scopes import (
    DeclaredRoute,
    Scoped,
    ScopeUndeclared,
    check_every_route_declares_a_scope,
    public,
    require,
    route_table,
)
from scanner_service.api.server import Listening
from tests.unit.api.small_service import client, served, small_app


@dataclass
class Service:
    app: FastAPI
    listening: Listening
    keys: dict[Role, str]

    @property
    def access(self) -> Access:
        access: Access = self.app.state.access
        return access


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    app = small_app(tmp_path_factory.mktemp("data"))
    keys = {role: app.state.access.create_key(role, f"a {role.name}") for role in Role}
    with served(app) as listening:
        yield Service(app, listening, keys)


def ask(service: Service, route: DeclaredRoute, method: str, key: str | None) -> int:
    """The status a route answers with; 101 for a WebSocket that was accepted."""
    if route.kind != "WebSocket":
        with client(service.listening, key) as http:
            path = route.path.replace("{slug}", "bad-host") + ("/x" if route.kind == "Mount" else "")
            return http.request(method, path, follow_redirects=False).status_code
    headers = {"Authorization": f"Bearer {key}"} if key else {}
    url = service.listening.url.replace("http", "ws", 1) + route.path
    try:
        with ws_client.connect(url, additional_headers=headers, proxy=None, close_timeout=0.05):
            return 101
    except InvalidStatus as refused:
        return refused.response.status_code


def test_every_route_method_and_role_agree_with_the_route_table(service: Service) -> None:
    table = route_table(service.app)
    cells = 0
    for route in table:
        if route.path in {"/api/v1/large", "/api/v1/broken", "/api/v1/login", "/login"}:
            continue  # public, and tested by their own tests
        for method in route.methods or {"GET"}:
            shown: dict[Role | None, str | None] = {None: None, **service.keys}
            for role, key in shown.items():
                status = ask(service, route, method, key)
                cells += 1
                if route.role is None or (role is not None and role >= route.role):
                    assert status not in {401, 403}, f"{route}: {role} got {status}"
                else:
                    assert status == (401 if role is None else 403), f"{route}: {role} got {status}"
            stranger = ask(service, route, method, make_key(Random(5).randbytes))
            assert (stranger == 401) == (route.role is not None)
    assert {route.kind for route in table} == {"Route", "WebSocket", "Mount"}
    assert {route.role for route in table} == {None, *Role}
    assert cells >= 4 * 12


def undeclared_route(app: FastAPI) -> None:
    app.add_api_route("/forgotten", lambda: None)


def undeclared_in_a_router_of_a_router(app: FastAPI) -> None:
    inner, outer = APIRouter(), APIRouter()
    inner.add_api_route("/forgotten", lambda: None)
    outer.include_router(inner, prefix="/inner")
    app.include_router(outer, prefix="/outer")


def undeclared_websocket(app: FastAPI) -> None:
    @app.websocket("/forgotten")
    async def live(websocket: WebSocket) -> None: ...


def undeclared_mount(app: FastAPI) -> None:
    app.mount("/forgotten", PlainTextResponse("x"))


def undeclared_starlette_route(app: FastAPI) -> None:
    app.add_route("/forgotten", lambda request: PlainTextResponse("x"))


def public_and_not(app: FastAPI) -> None:
    app.add_api_route(
        "/forgotten", lambda: None, dependencies=[Depends(public), Depends(require(Role.ADMIN))], methods=["GET"]
    )


@pytest.mark.parametrize(
    "forget",
    [
        undeclared_route,
        undeclared_in_a_router_of_a_router,
        undeclared_websocket,
        undeclared_mount,
        undeclared_starlette_route,
        public_and_not,
    ],
)
def test_a_route_without_a_clear_scope_keeps_the_service_from_starting(tmp_path: Path, forget: Any) -> None:
    app = small_app(tmp_path)
    forget(app)
    with pytest.raises(ScopeUndeclared, match="forgotten"):
        check_every_route_declares_a_scope(app)


def test_fastapis_own_pages_count_as_undeclared() -> None:
    with pytest.raises(ScopeUndeclared, match=r"/openapi\.json"):
        check_every_route_declares_a_scope(FastAPI())


def test_a_scope_may_be_declared_by_router_by_parameter_and_by_mount() -> None:
    app = FastAPI(openapi_url=None)
    router = APIRouter(dependencies=[Depends(require(Role.VIEWER))])

    @router.get("/a")
    async def a() -> None: ...

    @router.get("/b")
    async def b(who: Annotated[Identity, Depends(require(Role.ADMIN))]) -> None: ...

    app.include_router(router, prefix="/x")
    app.mount("/c", Scoped(PlainTextResponse("c"), require(Role.OPERATOR)))
    assert {(route.path, route.role) for route in route_table(app)} == {
        ("/x/a", Role.VIEWER),
        ("/x/b", Role.ADMIN),
        ("/c", Role.OPERATOR),
    }


def test_the_one_time_address_logs_a_browser_in_once(service: Service) -> None:
    address = login_url(service.access, service.listening.url)
    with client(service.listening) as http:
        assert http.head(address).status_code == 405  # a look ahead does not use it up
        first = http.get(address)
        assert (first.status_code, first.headers["location"]) == (303, "/")
        who = http.get("/api/v1/whoami").json()
        assert (who["role"], who["means"]) == ("admin", "cookie")
    with client(service.listening) as other:
        second = other.get(address)
        assert (second.status_code, second.json()["type"]) == (401, "/problems/login-unknown")
        assert "set-cookie" not in second.headers
        shown = other.get(address, headers={"Accept": "text/html,*/*;q=0.8"})  # a person, whom the page tells the rest
        assert (shown.status_code, shown.headers["location"], "set-cookie" in shown.headers) == (303, "/", False)
        assert other.get("/api/v1/whoami").status_code == 401


def test_the_cookie_is_out_of_reach_of_scripts_and_other_sites(service: Service) -> None:
    with client(service.listening) as http:
        response = http.get(login_url(service.access, service.listening.url))
    (cookie,) = SimpleCookie(response.headers["set-cookie"]).values()
    assert cookie.key == f"scanner_session_{service.listening.port}"
    assert cookie["httponly"] is True
    assert cookie["samesite"] == "strict"
    assert cookie["path"] == "/"
    assert cookie["domain"] == ""
    assert len(bytes.fromhex(cookie.value)) == 32


def test_over_tls_the_cookie_is_secure_and_bound_to_the_host(tmp_path: Path) -> None:
    app = small_app(tmp_path)
    key = app.state.access.create_key(Role.VIEWER, "x")

    async def over_tls() -> httpx.Response:
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="https://127.0.0.1:8443") as http:
            response = await http.post("/api/v1/login", json={"key": key})
            assert (await http.get("/api/v1/whoami")).json()["role"] == "viewer"
            return response

    (cookie,) = SimpleCookie(asyncio.run(over_tls()).headers["set-cookie"]).values()
    assert cookie.key.startswith("__Host-")
    assert cookie["secure"] is True


def test_a_browser_may_log_in_with_a_key_and_out_again(service: Service) -> None:
    with client(service.listening, Origin=service.listening.url) as http:
        assert http.post("/api/v1/login", json={"key": service.keys[Role.VIEWER]}).status_code == 204
        assert http.get("/api/v1/whoami").json()["role"] == "viewer"
        kept = dict(http.cookies)
        assert http.delete("/api/v1/lines").status_code == 403
        assert http.post("/api/v1/logout").status_code == 204
        assert http.get("/api/v1/whoami").status_code == 401
        http.cookies.update(kept)
        assert http.get("/api/v1/whoami").status_code == 401
        wrong = http.post("/api/v1/login", json={"key": service.keys[Role.VIEWER][:-1]})
        assert (wrong.status_code, wrong.json()["type"]) == (401, "/problems/key-mistyped")


def test_a_wrong_key_is_not_made_good_by_a_right_cookie(service: Service) -> None:
    with client(service.listening) as http:
        http.get(login_url(service.access, service.listening.url))
        for header in ["Bearer scn_x", "Basic eDp5", "Bearer", ""]:
            response = http.get("/api/v1/whoami", headers={"Authorization": header})
            assert response.status_code == 401
            assert response.headers["www-authenticate"].startswith("Bearer")


def test_a_websocket_takes_key_subprotocol_or_cookie_and_never_echoes_the_key(service: Service) -> None:
    url = service.listening.url.replace("http", "ws", 1) + "/api/v1/live"
    key = service.keys[Role.VIEWER]
    offered = [Subprotocol("scanner.v1"), Subprotocol(f"bearer.{key}")]
    with ws_client.connect(url, subprotocols=offered, origin=service.listening.url, proxy=None) as live:
        assert live.recv() == "VIEWER key"
        assert live.subprotocol == "scanner.v1"
    with client(service.listening) as http:
        http.get(login_url(service.access, service.listening.url))
        cookie = "; ".join(f"{name}={value}" for name, value in http.cookies.items())
    headers = {"Cookie": cookie}
    with ws_client.connect(url, additional_headers=headers, origin=service.listening.url, proxy=None) as live:
        assert live.recv() == "ADMIN cookie"
    with pytest.raises(InvalidStatus) as refused, ws_client.connect(url, additional_headers=headers, proxy=None):
        pass
    assert b"/problems/missing-origin" in (refused.value.response.body or b"")


def test_who_is_not_known_learns_nothing_of_the_schema(service: Service) -> None:
    with client(service.listening) as http:
        assert http.post("/api/v1/lines", json={"nonsense": 1}).status_code == 401
