"""The web application: routers, problems, guard and viewer put together; decides nothing itself."""

from fastapi import Depends, FastAPI
from starlette.responses import FileResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp

from drivers.errors import DriverError, PassRefused, PortAbsent, PortBusy, PortNotPermitted
from scanner_service import __version__, web
from scanner_service.analysis.errors import MapFull, MethodRefused, MethodUnknown, TooManyPasses
from scanner_service.api.access import ACCESS_PROBLEMS
from scanner_service.api.docs_page import install_docs
from scanner_service.api.errors import ExportUnknown, NotConfirmed, ValueUnusable
from scanner_service.api.guard import Guard, GuardRules
from scanner_service.api.login import login_router
from scanner_service.api.origins import Allowlist
from scanner_service.api.problems import Problem, ProblemTable, register_problems
from scanner_service.api.routes import analyses, exports, files, health, live, passes, results, scanlines, sessions
from scanner_service.api.scopes import Scoped, check_every_route_declares_a_scope, public
from scanner_service.api.service import Service
from scanner_service.rescan.passes.errors import PassOutOfReach, PlanningError
from scanner_service.rescan.reference import ReferenceUnusable
from scanner_service.rescan.requirement import RequirementUnusable
from scanner_service.sessions.errors import (
    AnalysesBusy,
    AnalysisNotDone,
    AnalysisUnknown,
    BudgetSpent,
    FileUnknown,
    KernelsCompiling,
    LineRefused,
    NameTaken,
    PartNotTurned,
    PassUnknown,
    PlanOvertaken,
    SessionBusy,
    SessionError,
    SessionNotLive,
    SourceUnusable,
)
from scanner_service.sessions.file_shelf import MAX_FILE_BYTES
from scanner_service.storage.errors import CreationKeyReused, RecordBusy, RecordError, SessionUnknown
from scanner_service.storage.exports.errors import ExportError, ExtraMissing, FormatNotWritten
from scanner_service.storage.formats.errors import FormatError

SESSION_PROBLEMS: ProblemTable = {
    SessionUnknown: Problem(404, "session-unknown", "There is no such session"),
    SessionBusy: Problem(409, "session-busy", "The session is in another state"),
    SessionNotLive: Problem(409, "session-not-live", "The session is not open"),
    KernelsCompiling: Problem(503, "kernels-compiling", "The service is not ready yet", {"Retry-After": "2"}),
    BudgetSpent: Problem(507, "budget-spent", "The disk budget is used up"),
    NotConfirmed: Problem(409, "not-confirmed", "Deleting needs a confirmation"),
    CreationKeyReused: Problem(422, "idempotency-key-reused", "The key came before, with another request"),
    SessionError: Problem(409, "session-error", "The session cannot do that"),
    PassUnknown: Problem(404, "pass-unknown", "There is no such pass"),
    PartNotTurned: Problem(409, "part-not-turned", "The part must be turned first"),
    PlanOvertaken: Problem(409, "plan-overtaken", "The plan is no longer in force"),
    PassOutOfReach: Problem(422, "pass-out-of-reach", "The pass would leave the limits of the rig"),
    PlanningError: Problem(409, "planning-impossible", "No pass can be planned"),
    SourceUnusable: Problem(422, "source-unusable", "The source cannot be read"),
    FileUnknown: Problem(404, "file-unknown", "There is no such file"),
    NameTaken: Problem(409, "name-taken", "Another file has that name"),
    FormatError: Problem(422, "file-unusable", "The file cannot be read"),
    LineRefused: Problem(409, "line-refused", "The scanline was not taken"),
    PortAbsent: Problem(404, "port-absent", "There is no such port"),
    PortBusy: Problem(409, "port-busy", "The port is held"),
    PortNotPermitted: Problem(403, "port-not-permitted", "The port may not be opened"),
    PassRefused: Problem(422, "pass-refused", "The scanner cannot drive this pass"),
    DriverError: Problem(502, "scanner-error", "The scanner does not do its part"),
    TooManyPasses: Problem(409, "too-many-passes", "Too many passes are open"),
    TimeoutError: Problem(503, "record-slow", "The disk does not answer"),
    AnalysisUnknown: Problem(404, "analysis-unknown", "There is no such analysis"),
    AnalysisNotDone: Problem(409, "analysis-not-done", "The analysis has no result"),
    AnalysesBusy: Problem(503, "analyses-busy", "Too many analyses are waiting"),
    MethodUnknown: Problem(422, "method-unknown", "There is no such method"),
    MethodRefused: Problem(422, "method-refused", "The method cannot do that"),
    MapFull: Problem(507, "map-full", "The live map is full"),
    RecordBusy: Problem(503, "record-busy", "The record cannot take more now"),
    RecordError: Problem(500, "record-error", "The record failed"),
    ReferenceUnusable: Problem(422, "reference-unusable", "No scan could be measured against this mesh"),
    RequirementUnusable: Problem(422, "requirement-unusable", "No scan could be judged by this"),
    ValueUnusable: Problem(422, "invalid-value", "A value cannot be used"),
    ExportUnknown: Problem(404, "export-unknown", "There is no such export"),
    FormatNotWritten: Problem(422, "format-unknown", "There is no such format"),
    ExtraMissing: Problem(501, "format-not-installed", "The format needs a library that is not installed"),
    ExportError: Problem(507, "export-failed", "The file could not be written"),
}
PUSH_BODY_BYTES = 4 << 20


def make_app(service: Service, allowlist: Allowlist | None = None) -> ASGIApp:
    """The guarded application of a service; raises ScopeUndeclared when a route does not say who may use it."""
    app = FastAPI(
        title="scanner", version=__version__, docs_url=None, redoc_url=None, openapi_url=None, redirect_slashes=False
    )
    app.state.service = service
    app.state.access = service.access
    problems: dict[type[Exception], Problem] = dict(SESSION_PROBLEMS)
    problems.update(ACCESS_PROBLEMS)
    register_problems(app, problems)
    install_docs(app, problems.values())
    app.include_router(login_router())
    for module in (health, sessions, scanlines, results, passes, exports, live, analyses, files):
        app.include_router(module.router)

    @app.get("/", dependencies=[Depends(public)], include_in_schema=False)
    async def page() -> Response:
        return FileResponse(web.INDEX_HTML)

    app.mount("/static", Scoped(StaticFiles(directory=web.STATIC_DIR), public), name="static")
    check_every_route_declares_a_scope(app)
    rules = GuardRules(
        allowlist=allowlist or Allowlist(),
        csp=web.CONTENT_SECURITY_POLICY,
        body_limits_bytes={"/api/v1/sessions/": PUSH_BODY_BYTES, "/api/v1/files/": MAX_FILE_BYTES},
    )
    return Guard(app, rules)
