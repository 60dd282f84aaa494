"""The API's own documentation: `/docs`, `/openapi.json`, and `/problems/SLUG`; everything served from here.

Swagger UI is vendored unmodified (`web/vendor/swagger`), so the page works without a network, and it is the page that
integrators know, with requests to try. It starts from a script file: no inline script, no CDN, no validator.
"""

import re
from collections.abc import Iterable
from html import escape
from http import HTTPStatus
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Depends, FastAPI, Header
from starlette.exceptions import HTTPException
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.staticfiles import StaticFiles

from scanner_service.api.explanations import Explanation, explanation_of
from scanner_service.api.guard import GUARD_PROBLEMS
from scanner_service.api.problems import STANDARD_PROBLEMS, Problem, problem_of_status
from scanner_service.api.scopes import Requirement, Scoped, public

SWAGGER_DIR = Path(__file__).resolve().parent.parent / "web" / "vendor" / "swagger"
# Swagger UI sets style attributes; scripts stay limited to files of this service.
DOCS_CSP = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)

_PAGE = """<!doctype html>
<html lang="en">
<head><meta charset="utf-8"><title>scanner: API</title><link rel="icon" href="data:,">
<link rel="stylesheet" href="/docs/assets/swagger-ui.css"></head>
<body><div id="docs"><noscript>The description itself is at <a href="/openapi.json">/openapi.json</a>.</noscript></div>
<script src="/docs/assets/swagger-ui-bundle.js"></script><script src="/docs/start.js"></script></body>
</html>
"""
_START = """SwaggerUIBundle({
  url: "/openapi.json", dom_id: "#docs", deepLinking: true, validatorUrl: null, queryConfigEnabled: false
});
"""


_PROBLEM = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><link rel="icon" href="data:,"><style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 42rem; margin: 3rem auto; padding: 0 1rem }}
dt {{ font-weight: 600 }} dd {{ margin: 0 0 .8rem }} code {{ background: #eee; padding: 0 .2em }}
</style></head><body><h1>{title}</h1><p>HTTP status {status}</p><dl>
<dt>What happened</dt><dd>{happened}</dd><dt>What to do</dt><dd>{remedy}</dd>
<dt>Read on</dt><dd><code>{read}</code> of the program's documents; <a href="/docs">all routes</a></dd></dl>
</body></html>
"""


def _as_html(told: Explanation) -> dict[str, str]:
    """Its lines, what stands between backticks as code."""
    return {name: re.sub(r"`([^`]*)`", r"<code>\1</code>", escape(text)) for name, text in told._asdict().items()}


def install_docs(app: FastAPI, problems: Iterable[Problem] = (), requirement: Requirement = public) -> None:
    """Add the documentation to an application made with `docs_url=None, redoc_url=None, openapi_url=None`.

    Parameters
    ----------
    problems : those that `/problems/SLUG` explains, besides the ones of this package and of bare HTTP statuses.
    requirement : who may read the documentation; the program is open, so everyone may by default.
    """
    router = APIRouter(include_in_schema=False, dependencies=[Depends(requirement)])
    bare = (*(problem_of_status(status) for status in HTTPStatus if status >= 400), *STANDARD_PROBLEMS)
    by_slug = {problem.slug: problem for problem in (*bare, *GUARD_PROBLEMS, *problems)}

    @router.get("/docs")
    async def docs() -> Response:
        return HTMLResponse(_PAGE, headers={"Content-Security-Policy": DOCS_CSP})

    @router.get("/docs/start.js")
    async def start() -> Response:
        return Response(_START, media_type="text/javascript")

    @router.get("/openapi.json")
    async def openapi() -> Response:
        return JSONResponse(app.openapi())

    @router.get("/problems/{slug}")
    async def problem_type(slug: str, accept: Annotated[str, Header()] = "") -> Response:
        if slug not in by_slug:
            raise HTTPException(404, "There is no problem of that name.")
        problem = by_slug[slug]
        told = explanation_of(slug, problem.status)
        if "text/html" in accept:  # a person, who has followed the address
            page = _PROBLEM.format(status=problem.status, title=escape(problem.title), **_as_html(told))
            return HTMLResponse(page, headers={"Content-Security-Policy": DOCS_CSP})
        head = {"type": f"/problems/{slug}", "title": problem.title, "status": problem.status}
        return JSONResponse(head | told._asdict())

    app.include_router(router)
    app.mount("/docs/assets", Scoped(StaticFiles(directory=SWAGGER_DIR), requirement), name="docs-assets")
