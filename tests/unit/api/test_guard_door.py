"""What the guard lets in, asked over real connections."""

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import websockets.sync.client as ws_client
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.exceptions import InvalidStatus

from scanner_service.api.guard import MIB, Guard, GuardRules
from scanner_service.api.keys import read_local_key
from scanner_service.api.origins import Allowlist
from scanner_service.api.server import Listening, ServerLimits
from tests.unit.api.small_service import client, raw_exchange, served, small_app

RULES = GuardRules(
    Allowlist(hosts=frozenset({"scan.example:8443"}), origins=frozenset({"https://scan.example:8443"})),
    body_limits_bytes={"/api/v1/bulk": 4 * MIB},
    body_deadline_s=0.4,
)


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def listening(data_dir: Path) -> Iterator[Listening]:
    with served(small_app(data_dir), RULES, ServerLimits(keep_alive_s=1)) as where:
        yield where


@pytest.fixture(scope="module")
def key(data_dir: Path, listening: Listening) -> str:
    return read_local_key(data_dir) or ""


def slug(response: httpx.Response) -> str:
    assert response.headers["content-type"] == "application/problem+json"
    document = response.json()
    assert document["status"] == response.status_code
    return str(document["type"]).removeprefix("/problems/")


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example", "127.0.0.1:1", "localhost.", "[::2]"])
def test_a_foreign_host_is_refused_even_on_public_routes(listening: Listening, host: str) -> None:
    with client(listening) as http:
        response = http.get("/docs", headers={"Host": host})
    assert slug(response) in {"foreign-host", "bad-host"}


def test_the_service_answers_to_its_loopback_names_and_to_configured_ones(listening: Listening) -> None:
    with client(listening) as http:
        for host in [f"127.0.0.1:{listening.port}", f"LOCALHOST:{listening.port}", f"[0::1]:{listening.port}"]:
            assert http.get("/docs", headers={"Host": host}).status_code == 200
        assert http.get("/docs", headers={"Host": "scan.example:8443"}).status_code == 200
        assert http.get("/docs", headers={"Host": "scan.example"}).status_code == 421


def test_an_absolute_request_target_does_not_replace_the_host(listening: Listening) -> None:
    own = f"127.0.0.1:{listening.port}".encode()
    answer = raw_exchange(
        listening, b"GET http://evil.example/docs HTTP/1.1\r\nHost: " + own + b"\r\nConnection: close\r\n\r\n"
    )
    assert answer.startswith(b"HTTP/1.1 400 ")


@pytest.mark.parametrize(
    "path", ["/../etc/passwd", "/docs/assets/%2e%2e/x", "/open/..%5c..%5cx", "/open/%00", "/a/./b"]
)
def test_dot_segments_backslashes_and_control_characters_reach_no_route(listening: Listening, path: str) -> None:
    own = f"127.0.0.1:{listening.port}"
    answer = raw_exchange(listening, f"GET {path} HTTP/1.1\r\nHost: {own}\r\nConnection: close\r\n\r\n".encode())
    assert answer.startswith(b"HTTP/1.1 400 ") and b"/problems/bad-path" in answer


@pytest.mark.parametrize("origin", ["https://evil.example", "null", "http://127.0.0.1:1", "http://localhost", "x", ""])
def test_a_page_of_another_origin_changes_nothing_whatever_it_carries(
    listening: Listening, key: str, origin: str
) -> None:
    with client(listening, key) as http:
        response = http.delete("/api/v1/lines", headers={"Origin": origin})
    assert slug(response) == "foreign-origin"


def test_own_and_configured_origins_may_change_things(listening: Listening, key: str) -> None:
    with client(listening, key) as http:
        for origin in [listening.url, "https://scan.example:8443"]:
            assert http.delete("/api/v1/lines", headers={"Origin": origin}).status_code == 200


def test_without_an_origin_a_key_is_enough_and_a_cookie_is_not(listening: Listening, key: str) -> None:
    with client(listening, key) as http:
        assert http.delete("/api/v1/lines").status_code == 200
    with client(listening, Cookie="scanner_session=x") as http:
        assert slug(http.delete("/api/v1/lines")) == "missing-origin"


def test_a_foreign_origin_opens_no_websocket(listening: Listening, key: str) -> None:
    url = f"ws://127.0.0.1:{listening.port}/api/v1/live"
    headers = {"Authorization": f"Bearer {key}"}
    with pytest.raises(InvalidStatus) as refused, ws_client.connect(url, origin="https://evil.example"):
        pass
    assert refused.value.response.status_code == 403
    assert b"/problems/foreign-origin" in (refused.value.response.body or b"")
    with ws_client.connect(url, origin=listening.url, additional_headers=headers, proxy=None) as live:
        assert live.recv() == "ADMIN key"


def test_a_body_over_the_limit_is_refused_while_it_streams(listening: Listening) -> None:
    sent = 0

    def stream() -> Iterator[bytes]:
        nonlocal sent
        for _ in range(32):
            sent += 65536
            yield bytes(65536)

    with client(listening) as http:
        response = http.post("/api/v1/raw", content=stream())  # chunked: nothing is declared
        assert slug(response) == "body-too-large"
        declared = http.post("/api/v1/raw", content=bytes(MIB + 1))
        assert slug(declared) == "body-too-large"
        whole = http.post("/api/v1/raw", content=bytes(MIB))
        assert whole.json() == {"bytes": MIB}


def test_a_path_prefix_may_have_a_limit_of_its_own(listening: Listening) -> None:
    with client(listening) as http:
        assert http.post("/api/v1/bulk/raw", content=iter([bytes(MIB)] * 4)).json() == {"bytes": 4 * MIB}
        assert slug(http.post("/api/v1/bulk/raw", content=iter([bytes(MIB)] * 5))) == "body-too-large"


@pytest.mark.parametrize("content_type", ["application/json", "application/octet-stream"])
def test_a_body_that_stops_arriving_is_answered(listening: Listening, content_type: str) -> None:
    head = f"POST /api/v1/raw HTTP/1.1\r\nHost: 127.0.0.1:{listening.port}\r\nContent-Type: {content_type}\r\n"
    answer = raw_exchange(listening, head.encode() + b"Content-Length: 100\r\n\r\n[1")
    assert answer.startswith(b"HTTP/1.1 408 ") and b"/problems/body-too-slow" in answer


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (b'{"line_spacing_mm": NaN}', "json-not-finite"),
        (b'{"line_spacing_mm": -Infinity}', "json-not-finite"),
        (b'{"line_spacing_mm": 1e999}', "json-not-finite"),
        ('{"line_spacing_mm": NaN}'.encode("utf-16"), "json-encoding"),
        ('{"line_spacing_mm": NaN}'.encode("utf-32-le"), "json-encoding"),
        (b"[" * 100_000, "json-depth"),
        (b'{"a":' * 33, "json-depth"),
        (b'{"line_spacing_mm": 0.', "malformed-json"),
        (b'"', "malformed-json"),
    ],
)
def test_json_that_must_not_be_parsed_is_a_bad_request(
    listening: Listening, key: str, body: bytes, reason: str
) -> None:
    with client(listening, key, **{"Content-Type": "Application/JSON; charset=x"}) as http:
        response = http.post("/api/v1/lines", content=body)
    assert (response.status_code, slug(response)) == (400, reason)


@pytest.mark.parametrize("media", ["multipart/form-data; boundary=x", "application/x-www-form-urlencoded"])
def test_forms_are_not_taken(listening: Listening, media: str) -> None:
    with client(listening) as http:
        assert slug(http.post("/api/v1/raw", content=b"a=1", headers={"Content-Type": media})) == "media-type-refused"
        packed = http.post("/api/v1/raw", content=b"x", headers={"Content-Encoding": "gzip"})
        assert slug(packed) == "media-type-refused"


@pytest.mark.parametrize("path", ["/docs", "/nowhere", "/api/v1/lines", "/api/v1/broken", "/open/x", "/a/../b"])
def test_every_answer_carries_the_secure_headers(listening: Listening, path: str) -> None:
    with client(listening) as http:
        headers = http.get(path).headers
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"
    assert headers["cross-origin-opener-policy"] == headers["cross-origin-resource-policy"] == "same-origin"
    assert "default-src 'none'" in headers["content-security-policy"]
    assert "'unsafe-inline'" not in headers["content-security-policy"].split("script-src")[1].split(";")[0]
    assert "server" not in headers
    assert (headers.get("cache-control") == "no-store") == path.startswith("/api")


ATTACKS = st.fixed_dictionaries(
    {
        "host": st.one_of(
            st.sampled_from(["evil.example", "127.0.0.1.nip.example:8000", "localhost:80", "127.0.0.1", "", "[::1]"]),
            st.text(st.characters(max_codepoint=255), max_size=30),
        ),
        "origin": st.one_of(
            st.sampled_from(["null", "http://127.0.0.1:8000.evil.example", "http://127.0.0.1:8000@evil.example"]),
            st.text(st.characters(max_codepoint=255), max_size=30),
        ),
        "own_host": st.booleans(),
        "websocket": st.booleans(),
        "method": st.sampled_from(["POST", "PUT", "PATCH", "DELETE"]),
    }
)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(ATTACKS)
def test_no_request_of_a_foreign_page_reaches_the_application(attack: dict[str, Any]) -> None:
    if attack["origin"] == "http://127.0.0.1:8000":
        return
    reached = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        reached.append(scope)

    answers: list[Any] = []

    async def ask() -> None:
        host = "127.0.0.1:8000" if attack["own_host"] else attack["host"]
        scope = {
            "type": "websocket" if attack["websocket"] else "http",
            "scheme": "ws" if attack["websocket"] else "http",
            "method": attack["method"],
            "path": "/api/v1/lines",
            "server": ("127.0.0.1", 8000),
            "headers": [(b"host", host.encode("latin-1")), (b"origin", attack["origin"].encode("latin-1"))],
            "extensions": {"websocket.http.response": {}},
        }

        async def receive() -> Any:
            return {"type": "http.request", "body": b"", "more_body": False}

        async def send(message: Any) -> None:
            answers.append(message)

        await Guard(app, GuardRules())(scope, receive, send)

    asyncio.run(ask())
    assert not reached
    assert answers[0]["status"] in {400, 403, 421}


def test_the_guard_counts_what_it_refuses_by_reason(tmp_path: Path) -> None:
    guard = Guard(small_app(tmp_path), GuardRules())
    transport = httpx.ASGITransport(guard)

    async def ask() -> None:
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:8000") as http:
            await http.get("/docs", headers={"Host": "evil.example"})
            await http.post("/api/v1/raw", content=bytes(MIB + 1))
            await http.post("/api/v1/raw", content=_in_parts())
            await http.post("/api/v1/lines", json=[[[]]] * 2, headers={"Origin": "http://evil.example"})

    asyncio.run(ask())
    assert guard.refusals == {"foreign-host": 1, "body-too-large": 2, "foreign-origin": 1}


async def _in_parts() -> Any:
    for _ in range(3):
        yield bytes(MIB // 2)
