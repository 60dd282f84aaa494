"""The door of the service: which requests get in at all; knows no route, no key and no session.

Plain ASGI, in front of the whole application, for HTTP and WebSocket alike. It decides on raw headers and counted
bytes only, never on a URL that was put together from them, and puts the secure headers on every answer.
"""

import asyncio
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from scanner_service.api.json_limits import MAX_DEPTH, JsonRefused, check_json
from scanner_service.api.origins import DEFAULT_PORTS, Allowlist, Authority, Origin
from scanner_service.api.problems import Problem, ProblemRaised, problem_response, refuse_websocket

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
MIB = 1024 * 1024

BAD_HOST = Problem(400, "bad-host", "The Host header is missing or not a host")
FOREIGN_HOST = Problem(421, "foreign-host", "This service does not answer to that name")
FOREIGN_ORIGIN = Problem(403, "foreign-origin", "A page of another origin may not do this")
MISSING_ORIGIN = Problem(403, "missing-origin", "A cookie alone does not permit this")
BAD_PATH = Problem(400, "bad-path", "The path is not one this service could have")
BODY_TOO_LARGE = Problem(413, "body-too-large", "The body is too large")
BODY_TOO_SLOW = Problem(408, "body-too-slow", "The body did not arrive in time")
MEDIA_REFUSED = Problem(415, "media-type-refused", "Bodies of that kind are not taken")
JSON_REFUSED = {
    "json-encoding": Problem(400, "json-encoding", "The body is not UTF-8"),
    "json-not-finite": Problem(400, "json-not-finite", "The body holds a number that is not finite"),
    "json-depth": Problem(400, "json-depth", "The body nests too deep"),
}
GUARD_PROBLEMS = (
    *(BAD_HOST, FOREIGN_HOST, FOREIGN_ORIGIN, MISSING_ORIGIN, BAD_PATH),
    *(BODY_TOO_LARGE, BODY_TOO_SLOW, MEDIA_REFUSED),
    *JSON_REFUSED.values(),
)

PAGE_CSP = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "font-src 'self'; worker-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_SECURE_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class BodyRefused(ProblemRaised):
    """A body that broke a rule while the application was reading it."""


class _Refused(Exception):
    """A request that does not get in, with the problem to answer it by."""

    def __init__(self, problem: Problem, detail: str) -> None:
        super().__init__(detail)
        self.problem = problem


@dataclass(frozen=True, slots=True)
class GuardRules:
    """What the guard asks of a request.

    `body_limits_bytes` gives paths that start with a prefix a limit of their own, the longest prefix counting.
    `body_deadline_s` is the longest pause while a body arrives and, for JSON, the longest time for all of it. `csp`
    is the Content-Security-Policy of answers that set none themselves. Answers below `uncached_prefix` are not
    cached unless they say otherwise.
    """

    allowlist: Allowlist = field(default_factory=Allowlist)
    csp: str = PAGE_CSP
    body_limit_bytes: int = MIB
    body_limits_bytes: Mapping[str, int] = field(default_factory=dict)
    body_deadline_s: float = 20.0
    json_depth: int = MAX_DEPTH
    uncached_prefix: str = "/api"

    def limit_bytes(self, path: str) -> int:
        """The largest body a path takes."""
        fitting = [prefix for prefix in self.body_limits_bytes if path.startswith(prefix)]
        return self.body_limits_bytes[max(fitting, key=len)] if fitting else self.body_limit_bytes


class Guard:
    """ASGI middleware around the whole application: `served = Guard(app, GuardRules(...))`.

    `refusals` counts what was refused, by slug.
    """

    def __init__(self, app: ASGIApp, rules: GuardRules) -> None:
        self.app = app
        self.rules = rules
        self.refusals: Counter[str] = Counter()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let the request in, or answer it."""
        if scope["type"] not in {"http", "websocket"}:
            await self.app(scope, receive, send)
            return
        secured = _Secured(self.rules, scope, send)
        body = _Metered(self.rules, scope["path"], receive)
        try:
            _check_headers(self.rules, scope)
            if scope["type"] == "http":
                receive = await self._checked(scope, body)
            await self.app(scope, receive, secured)
        except _Refused as refusal:
            self.refusals[refusal.problem.slug] += 1
            await _answer(refusal.problem, str(refusal), scope, receive, secured)
        except BodyRefused as refusal:  # read by us, or by an application without a handler
            if not secured.started:
                await _answer(refusal.problem, str(refusal.detail), scope, receive, secured)
        finally:
            if body.refused is not None:
                self.refusals[body.refused.slug] += 1

    async def _checked(self, scope: Scope, body: "_Metered") -> Receive:
        """Check a JSON body before anyone parses it; let other bodies through, counted as they are read."""
        media = ",".join(Headers(scope=scope).getlist("content-type")).lower()
        # Asked as widely as possible: whatever a parser behind may take for JSON is checked.
        if "json" not in media:
            return body
        try:
            async with asyncio.timeout(self.rules.body_deadline_s):
                messages = await body.read_all()
        except TimeoutError:
            detail = f"The JSON body was not complete after {self.rules.body_deadline_s:g} s."
            raise _Refused(BODY_TOO_SLOW, detail) from None
        try:
            check_json(b"".join(message.get("body", b"") for message in messages), self.rules.json_depth)
        except JsonRefused as refusal:
            raise _Refused(JSON_REFUSED[refusal.slug], str(refusal)) from None
        return _Replayed(messages, body)


async def _answer(problem: Problem, detail: str, scope: Scope, receive: Receive, send: Send) -> None:
    response = problem_response(problem, detail)
    if scope["type"] == "websocket":
        await refuse_websocket(WebSocket(scope, receive, send), response)
    else:
        await response(scope, receive, send)


def _check_headers(rules: GuardRules, scope: Scope) -> None:
    """Host, path, Origin and media type.

    Raises
    ------
    _Refused : with the first rule that is broken.
    """
    headers = Headers(scope=scope)
    scheme = scope["scheme"]
    host = _one_host(headers.getlist("host"), scheme)
    listening = scope["server"][1] if scope.get("server") else None
    if not rules.allowlist.allows_host(host, scheme, listening):
        detail = f"This service does not answer to {host.host}:{host.port}; if it should, add it to the allowed hosts."
        raise _Refused(FOREIGN_HOST, detail)
    _check_path(scope["path"])
    _check_origin(rules, scope, headers, host)
    if scope["type"] == "http":
        _check_media(headers)
        declared = headers.get("content-length", "0")
        if declared.isascii() and declared.isdigit() and int(declared[:20]) > rules.limit_bytes(scope["path"]):
            raise _Refused(BODY_TOO_LARGE, _too_large(rules.limit_bytes(scope["path"])))


def _one_host(hosts: Iterable[str], scheme: str) -> Authority:
    match list(hosts):
        case [text] if (host := Authority.parse(text, DEFAULT_PORTS[scheme])) is not None:
            return host
    raise _Refused(BAD_HOST, "A request needs one Host header with a name or an address, and at most a port.")


def _check_path(path: str) -> None:
    """No path here has dot segments, backslashes or control characters, so none of them reaches a file system."""
    if not path.startswith("/"):
        raise _Refused(BAD_PATH, "The request target must be a path that starts with a slash.")
    if any(segment in {".", ".."} for segment in path.split("/")) or "\\" in path or not path.isprintable():
        raise _Refused(BAD_PATH, "The path holds a dot segment, a backslash or an unprintable character.")


def _check_origin(rules: GuardRules, scope: Scope, headers: Headers, host: Authority) -> None:
    """A browser states the page's origin whenever something is changed and for every WebSocket: it must be ours.

    A program states none. It then has to carry a key, since a cookie is sent by browsers without being asked.
    """
    if scope["type"] == "http" and scope["method"] in SAFE_METHODS:
        return
    origins = headers.getlist("origin")
    if not origins:
        if "cookie" in headers and "authorization" not in headers:
            detail = "Send the Origin header along with the cookie, or a key instead: Authorization: Bearer KEY."
            raise _Refused(MISSING_ORIGIN, detail)
        return
    origin = Origin.parse(origins[0]) if len(origins) == 1 else None
    if origin is None or not rules.allowlist.allows_origin(origin, host, scope["scheme"]):
        detail = "The page that sent this is of another origin; if it should be allowed, add it to the allowed origins."
        raise _Refused(FOREIGN_ORIGIN, detail)


def _check_media(headers: Headers) -> None:
    media = ",".join(headers.getlist("content-type")).lower()
    if "multipart/" in media or "x-www-form-urlencoded" in media:
        raise _Refused(
            MEDIA_REFUSED,
            "Forms are not taken; send JSON, or the bytes of a file as application/octet-stream (curl -T FILE does).",
        )
    coding = headers.get("content-encoding", "identity").strip().lower()
    if coding != "identity":
        raise _Refused(MEDIA_REFUSED, "Compressed bodies are not taken; send the body as it is.")


def _too_large(limit_bytes: int) -> str:
    return f"The body is larger than the {limit_bytes} bytes taken here; send it in smaller parts."


class _Metered:
    """A body that is counted as it arrives: not what a header declares, but what comes."""

    def __init__(self, rules: GuardRules, path: str, receive: Receive) -> None:
        self.refused: Problem | None = None
        self._receive = receive
        self._limit_bytes = rules.limit_bytes(path)
        self._pause_s = rules.body_deadline_s
        self._arrived_bytes = 0
        self._complete = False

    async def __call__(self) -> Message:
        if self._complete:  # what follows is the wait for the client to leave, which may be long
            return await self._receive()
        try:
            async with asyncio.timeout(self._pause_s):
                message = await self._receive()
        except TimeoutError:
            raise self._refusal(BODY_TOO_SLOW, f"No part of the body arrived for {self._pause_s:g} s.") from None
        self._complete = not message.get("more_body", False)
        self._arrived_bytes += len(message.get("body", b""))
        if self._arrived_bytes > self._limit_bytes:
            raise self._refusal(BODY_TOO_LARGE, _too_large(self._limit_bytes))
        return message

    async def read_all(self) -> list[Message]:
        """Every message up to the body's end, or up to the client's leaving."""
        messages = [await self()]
        while not self._complete:
            messages.append(await self())
        return messages

    def _refusal(self, problem: Problem, detail: str) -> BodyRefused:
        self.refused = problem
        return BodyRefused(problem, detail)


class _Replayed:
    """A body that was read and checked, handed on as it came."""

    def __init__(self, messages: list[Message], rest: Receive) -> None:
        self._messages = messages[::-1]
        self._rest = rest

    async def __call__(self) -> Message:
        return self._messages.pop() if self._messages else await self._rest()


class _Secured:
    """Puts the secure headers on whatever answer goes out; `started` says whether one has."""

    def __init__(self, rules: GuardRules, scope: Scope, send: Send) -> None:
        self._rules = rules
        self._send = send
        self._uncached = scope["path"].startswith(rules.uncached_prefix)
        self.started = False

    async def __call__(self, message: Message) -> None:
        if message["type"] in {"http.response.start", "websocket.http.response.start"}:
            self.started = True
            message.setdefault("headers", [])
            headers = MutableHeaders(scope=message)
            headers.update(_SECURE_HEADERS)
            headers.setdefault("Content-Security-Policy", self._rules.csp)
            if self._uncached:
                headers.setdefault("Cache-Control", "no-store")
        await self._send(message)
