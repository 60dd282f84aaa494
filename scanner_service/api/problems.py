"""Errors as RFC 9457 problem details: one table from error class to status; knows no route and no session.

A problem's `type` is `/problems/SLUG`, a reference that this service answers itself (`docs_page`), so it also works
without a network. What a client sent is never echoed: a NaN in an echo cannot be written as JSON, and an echo is a
gift to whoever probes.
"""

import json
import logging
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError, ResponseValidationError, WebSocketRequestValidationError
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection, Request
from starlette.responses import Response
from starlette.websockets import WebSocket

MEDIA_TYPE = "application/problem+json"
MAX_ERRORS_TOLD = 20
_MAX_TEXT = 300
_WORDS = {
    "Field required": "is missing",
    "Extra inputs are not permitted": "is not known here: leave it out",
    "Value error, ": "is refused: ",
    "Input tag ": "is of no known kind: ",
    **{f"{what} should ": "must " for what in ("Input", "String", "List", "Tuple", "Value", "Data")},
}

_log = logging.getLogger("scanner_service.api")


@dataclass(frozen=True, slots=True)
class Problem:
    """What a class of errors becomes on the wire: HTTP status, slug of its type, title, and headers to send along."""

    status: int
    slug: str
    title: str
    headers: Mapping[str, str] = field(default_factory=dict)


ProblemTable = Mapping[type[Exception], Problem]
# Starlette's own type allows requests or WebSockets, not one handler for both; these take both.
Handler = Callable[[Any, Exception], Awaitable[Any]]


class ProblemRaised(HTTPException):
    """An HTTP error that brings its own problem, to be raised where no table reaches."""

    def __init__(self, problem: Problem, detail: str) -> None:
        super().__init__(problem.status, detail, dict(problem.headers))
        self.problem = problem


MALFORMED_JSON = Problem(400, "malformed-json", "The body is not JSON")
INVALID_REQUEST = Problem(422, "invalid-request", "The request does not fit the schema")
# The server ends the connection after an unknown error; said beforehand, no client sends its next request into that.
INTERNAL = Problem(500, "internal-error", "The service failed", {"Connection": "close"})
STANDARD_PROBLEMS = (MALFORMED_JSON, INVALID_REQUEST, INTERNAL)


def problem_document(problem: Problem, detail: str, members: Mapping[str, object] | None = None) -> bytes:
    """The JSON document of a problem, ASCII only, so that no text can make it unwritable.

    Raises
    ------
    ValueError : when `members` hold NaN or an infinity; those must never be told as numbers.
    """
    document: dict[str, object] = {
        "type": f"/problems/{problem.slug}",
        "title": problem.title,
        "status": problem.status,
        "detail": _short(detail),
        **(members or {}),
    }
    return json.dumps(document, allow_nan=False).encode("ascii")


def problem_response(problem: Problem, detail: str, members: Mapping[str, object] | None = None) -> Response:
    """The problem as an HTTP answer."""
    body = problem_document(problem, detail, members)
    return Response(body, problem.status, headers=dict(problem.headers), media_type=MEDIA_TYPE)


def problem_of_status(status: int) -> Problem:
    """The problem that stands for a bare HTTP status, for example 404 -> `not-found`."""
    try:
        phrase = HTTPStatus(status).phrase
    except ValueError:
        phrase = f"Status {status}"
    return Problem(status, phrase.lower().replace(" ", "-").replace("'", ""), phrase)


def register_problems(app: FastAPI, table: ProblemTable) -> None:
    """Answer the errors of `table`, validation errors, HTTP errors and unknown errors with problem details.

    The detail of an error in the table is its message, so messages are written for readers. Unknown errors are
    answered without internals; the server logs their trace.

    Raises
    ------
    ValueError : when one slug of the table stands for two different statuses or titles.
    """
    seen: dict[str, Problem] = {}
    for error_class, problem in table.items():
        known = seen.setdefault(problem.slug, problem)
        if (known.status, known.title) != (problem.status, problem.title):
            raise ValueError(f"the slug {problem.slug!r} stands for two problems; give {error_class.__name__} its own")
        app.add_exception_handler(error_class, _answering(_from_table(problem)))
    app.add_exception_handler(RequestValidationError, _answering(_from_validation))
    app.add_exception_handler(WebSocketRequestValidationError, _answering(_from_validation))
    app.add_exception_handler(HTTPException, _answering(_from_http))
    app.add_exception_handler(ResponseValidationError, _answering(_unknown))
    app.add_exception_handler(Exception, _answering(_unknown))


def _answering(respond: Callable[[HTTPConnection, Exception], Response]) -> Handler:
    """Send the response as the answer to a request, or as the refusal of a WebSocket."""

    async def handler(connection: HTTPConnection, error: Exception) -> Response | None:
        response = respond(connection, error)
        if isinstance(connection, WebSocket):
            await refuse_websocket(connection, response)
            return None
        return response

    return handler


async def refuse_websocket(websocket: WebSocket, response: Response) -> None:
    """Refuse a WebSocket with a real HTTP answer where the server can, else close it with 1008 (policy)."""
    accepted = websocket.application_state.name != "CONNECTING"
    if accepted or "websocket.http.response" not in websocket.scope.get("extensions", {}):
        # RFC 6455 section 7.4.1: 1008 is a policy violation, 1011 an unexpected condition.
        await websocket.close(1011 if response.status_code >= 500 else 1008)
        return
    await websocket.send_denial_response(response)


def _from_table(problem: Problem) -> Callable[[HTTPConnection, Exception], Response]:
    def respond(connection: HTTPConnection, error: Exception) -> Response:
        if problem.status >= 500 and "Retry-After" not in problem.headers:  # which is said of what passes by itself
            _log.error("%s: %s: %s", connection.scope.get("path"), type(error).__name__, error)
        fields = getattr(error, "fields", ())  # what the client named them by, so that a form can say it beside them
        return problem_response(problem, str(error) or problem.title, {"fields": list(fields)} if fields else None)

    return respond


def _from_http(connection: HTTPConnection, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    problem = error.problem if isinstance(error, ProblemRaised) else problem_of_status(error.status_code)
    if error.status_code < 200 or error.status_code in {204, 304}:
        return Response(status_code=error.status_code, headers=error.headers)
    response = problem_response(problem, str(error.detail))
    response.headers.update(error.headers or {})
    return response


def _from_validation(connection: HTTPConnection, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError | WebSocketRequestValidationError)
    faults: Sequence[Mapping[str, object]] = error.errors()
    if any(fault.get("type") == "json_invalid" for fault in faults):
        return problem_response(MALFORMED_JSON, f"The body is not JSON at {_place(faults[0])}; send one JSON value.")
    told = [
        {"at": _place(fault), "message": _short(_said(str(fault.get("msg", "")))), "code": str(fault.get("type", ""))}
        for fault in faults[:MAX_ERRORS_TOLD]
    ]
    first = f"{told[0]['at']} {told[0]['message']}" if told else INVALID_REQUEST.title
    if len(faults) > 1:
        first += f"; {len(faults) - 1} more {'things are' if len(faults) > 2 else 'thing is'} wrong with the request"
    return problem_response(INVALID_REQUEST, first, {"errors": told, "error_count": len(faults)})


def _unknown(connection: HTTPConnection, error: Exception) -> Response:
    method = connection.scope["method"] if isinstance(connection, Request) else "WebSocket"
    # An answer that does not fit our own schema is caught here and nowhere else, so its text goes to the log; for
    # the rest the server logs the trace, since Starlette raises them again.
    told = str(error) if isinstance(error, ResponseValidationError) else ""
    _log.error("%s %s failed: %s %s", method, connection.scope.get("path"), type(error).__name__, told)
    return problem_response(INTERNAL, "The service failed on this request; its log says where. Nothing was confirmed.")


def _said(message: str) -> str:
    """What the checker of the schema says, as the rest of a sentence that begins with the place."""
    for begins, said in _WORDS.items():
        if message.startswith(begins):
            return said + message.removeprefix(begins)
    return f"is refused: {message}"


def _place(fault: Mapping[str, object]) -> str:
    """Where a fault is, for example `body.passes.0.line_spacing_mm`; field names of the client are cut short."""
    parts = fault.get("loc", ())
    assert isinstance(parts, tuple | list)
    return _short(".".join(_short(str(part)) for part in parts))


def _short(text: str) -> str:
    return text if len(text) <= _MAX_TEXT else text[: _MAX_TEXT - 1] + "…"
