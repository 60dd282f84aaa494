"""The routes by which a browser becomes known: one-time address, key, logout; translates and decides nothing."""

from typing import Annotated

from fastapi import APIRouter, Depends, Request
from pydantic import BaseModel, Field
from starlette.responses import JSONResponse, RedirectResponse, Response

from scanner_service.api.access import (
    Access,
    Identity,
    LoginUnknown,
    clear_session_cookie,
    cookie_name,
    set_session_cookie,
)
from scanner_service.api.keys import Role
from scanner_service.api.scopes import public, require


class KeyLogin(BaseModel):
    """A key to log a browser in with."""

    key: str = Field(max_length=200)


class Who(BaseModel):
    """Who is asking, as the service sees it."""

    role: str
    label: str
    means: str


def login_url(access: Access, base_url: str, role: Role = Role.ADMIN) -> str:
    """A one-time address for a person to open within ten minutes; `base_url` as in http://127.0.0.1:8000."""
    return f"{base_url}/login?token={access.issue_login(role)}"


def login_router() -> APIRouter:
    """`GET /login`, and `/api/v1/login`, `/logout`, `/whoami`, `/login-url`."""
    router = APIRouter(tags=["access"])

    @router.get("/login", dependencies=[Depends(public)], include_in_schema=False)
    async def open_one_time_address(request: Request, token: str) -> Response:
        access: Access = request.app.state.access
        response = RedirectResponse("/", status_code=303, headers={"Cache-Control": "no-store"})
        try:
            value = access.redeem_login(token)
        except LoginUnknown:
            if "text/html" not in request.headers.get("accept", ""):
                raise
            return response  # a person: the page knows whether the browser is signed in already, and says what to do
        set_session_cookie(response, request, value)
        return response

    @router.post("/api/v1/login", dependencies=[Depends(public)], status_code=204)
    async def log_in_with_key(request: Request, body: KeyLogin) -> Response:
        """Exchange a key for a browser session; the answer sets an HttpOnly cookie."""
        access: Access = request.app.state.access
        identity = access.identify_key(body.key)
        response = Response(status_code=204)
        set_session_cookie(response, request, access.open_session(identity.role, identity.label))
        return response

    @router.post("/api/v1/logout", dependencies=[Depends(public)], status_code=204)
    async def log_out(request: Request) -> Response:
        """End the browser session."""
        access: Access = request.app.state.access
        access.close_session(request.cookies.get(cookie_name(request), ""))
        response = Response(status_code=204)
        clear_session_cookie(response, request)
        return response

    @router.get("/api/v1/whoami")
    async def who_am_i(identity: Annotated[Identity, Depends(require(Role.VIEWER))]) -> Who:
        """The role that the key or cookie gives."""
        return Who(role=identity.role.name.lower(), label=identity.label, means=identity.means)

    @router.post("/api/v1/login-url", dependencies=[Depends(require(Role.ADMIN))])
    async def make_one_time_address(request: Request) -> Response:
        """A path with a one-time token, to be opened in a browser within ten minutes; for `scanner open`."""
        access: Access = request.app.state.access
        return JSONResponse({"path": login_url(access, "")}, headers={"Cache-Control": "no-store"})

    return router
