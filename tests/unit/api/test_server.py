"""The server: where it listens, and what it does with clients that keep it waiting."""

import contextlib
import shutil
import socket
import ssl
import subprocess
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import httpx
import pytest
import websockets.sync.client as ws_client
from fastapi import FastAPI
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import InvalidStatus

from scanner_service.api.connections import Deadlines
from scanner_service.api.guard import MIB, Guard, GuardRules
from scanner_service.api.keys import read_local_key
from scanner_service.api.login import login_url
from scanner_service.api.server import (
    AddressInUse,
    AddressRefused,
    AddressUnavailable,
    CertificateUnusable,
    Listening,
    ServerDidNotStart,
    ServerLimits,
    ServerThread,
    Tls,
    bind,
    is_loopback,
    uvicorn_config,
)
from tests.unit.api.small_service import client, raw_exchange, served, small_app

HURRIED = ServerLimits(Deadlines(headers_s=0.3, send_s=0.3), connections=20, keep_alive_s=30)


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def listening(data_dir: Path) -> Iterator[Listening]:
    with served(small_app(data_dir), limits=HURRIED) as where:
        yield where


@pytest.mark.parametrize("part", [b"", b"G", b"GET / HTTP/1.1\r\n", b"GET / HTTP/1.1\r\nHost: x\r\nX: " + b"y" * 9000])
def test_half_a_request_is_ended_at_the_deadline(listening: Listening, part: bytes) -> None:
    # The server alone ends it: reading here has no deadline but the test's own.
    assert raw_exchange(listening, part).startswith(b"HTTP/1.1 408 ")


def test_bytes_that_trickle_do_not_move_the_deadline(listening: Listening) -> None:
    with socket.create_connection((listening.host, listening.port), timeout=30) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nX: ")
        ended = threading.Event()

        def trickle() -> None:
            while not ended.wait(0.05):
                try:
                    connection.sendall(b"y")
                except OSError:
                    return

        trickling = threading.Thread(target=trickle)
        trickling.start()
        try:
            assert connection.recv(100).startswith(b"HTTP/1.1 408 ")
        finally:
            ended.set()
            trickling.join()


def test_the_second_request_of_a_connection_has_the_same_deadline(listening: Listening) -> None:
    host = f"Host: 127.0.0.1:{listening.port}\r\n\r\n".encode()
    answer = raw_exchange(listening, b"GET /problems/bad-host HTTP/1.1\r\n" + host + b"GET /docs HT")
    assert answer.startswith(b"HTTP/1.1 200 ")
    assert b"HTTP/1.1 408 " in answer
    with socket.create_connection((listening.host, listening.port), timeout=30) as connection:
        connection.sendall(b"GET /problems/bad-host HTTP/1.1\r\n" + host)
        first = connection.recv(65536)
        assert first.startswith(b"HTTP/1.1 200 ")
        connection.sendall(b"GET /docs HT")
        rest = b""
        while part := connection.recv(65536):
            rest += part
    assert b"HTTP/1.1 408 " in rest


def test_a_refused_body_is_not_drained_for_ever(listening: Listening) -> None:
    head = f"POST /api/v1/raw HTTP/1.1\r\nHost: 127.0.0.1:{listening.port}\r\nContent-Length: 200000000\r\n\r\n"
    with socket.create_connection((listening.host, listening.port), timeout=30) as connection:
        connection.sendall(head.encode())
        assert connection.recv(65536).startswith(b"HTTP/1.1 413 ")
        with pytest.raises(OSError):  # reset or broken pipe, as the system has it
            while True:
                connection.sendall(bytes(1000))


def test_headers_beyond_the_limit_are_refused(listening: Listening) -> None:
    answer = raw_exchange(listening, b"GET / HTTP/1.1\r\nX: " + b"y" * 100_000)
    assert answer.startswith((b"HTTP/1.1 400 ", b"HTTP/1.1 431 "))


def test_a_client_that_never_reads_is_cut_off(listening: Listening) -> None:
    request = f"GET /api/v1/large HTTP/1.1\r\nHost: 127.0.0.1:{listening.port}\r\n\r\n".encode()
    with socket.socket() as connection:
        connection.settimeout(30)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.connect((listening.host, listening.port))
        connection.sendall(request)
        assert _cut_off(connection, b"\r\n")


def test_a_websocket_client_that_never_reads_is_cut_off(listening: Listening, data_dir: Path) -> None:
    head = (
        f"GET /api/v1/flood HTTP/1.1\r\nHost: 127.0.0.1:{listening.port}\r\nUpgrade: websocket\r\n"
        f"Connection: Upgrade\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
        f"Authorization: Bearer {read_local_key(data_dir)}\r\n\r\n"
    )
    with socket.socket() as connection:
        connection.settimeout(30)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.connect((listening.host, listening.port))
        connection.sendall(head.encode())
        assert _cut_off(connection, b"\x8a\x80\0\0\0\0")  # an unsolicited pong, which a server ignores


def _cut_off(connection: socket.socket, harmless: bytes) -> bool:
    """Wait, without reading, until the other side gave up: then what is sent is answered by a reset."""
    waiting = threading.Event()
    for _ in range(200):
        try:
            connection.send(harmless)
        except OSError:
            return True
        waiting.wait(0.05)
    return False


def test_deflate_is_off_and_long_messages_of_clients_are_refused(listening: Listening, data_dir: Path) -> None:
    url = listening.url.replace("http", "ws", 1) + "/api/v1/live"
    headers = {"Authorization": f"Bearer {read_local_key(data_dir)}"}
    with ws_client.connect(url, additional_headers=headers, compression="deflate", proxy=None) as live:
        assert live.response is not None
        assert "sec-websocket-extensions" not in live.response.headers
    config = uvicorn_config(FastAPI())
    assert config.ws_max_size <= MIB
    assert not config.ws_per_message_deflate


def test_there_is_a_limit_to_websockets_too(data_dir: Path) -> None:
    limits = ServerLimits(connections=3)
    with served(small_app(data_dir), limits=limits) as where:
        url = where.url.replace("http", "ws", 1) + "/api/v1/flood"
        headers = {"Authorization": f"Bearer {read_local_key(data_dir)}"}
        with contextlib.ExitStack() as stack:
            for _ in range(3):
                client = ws_client.connect(url, additional_headers=headers, proxy=None, max_queue=1, close_timeout=0.1)
                stack.enter_context(client)
            with pytest.raises(InvalidStatus, match="503"):
                stack.enter_context(ws_client.connect(url, additional_headers=headers, proxy=None))


@given(st.one_of(st.ip_addresses(v=4), st.ip_addresses(v=6)))
def test_only_loopback_addresses_are_bound_without_tls(address: object) -> None:
    text = str(address)
    if text.startswith("127.") or text == "::1":
        assert is_loopback(text)
        return
    assert not is_loopback(text)
    with pytest.raises(AddressRefused, match="certificate"):
        bind(text, 0)


@pytest.mark.parametrize(
    "host", ["0.0.0.0", "::", "scan.example", "127.0.0.1.evil.example", "", "localhost.evil.example"]
)
def test_other_names_are_refused_without_tls(host: str) -> None:
    with pytest.raises(AddressRefused):
        ServerThread(FastAPI(), host).start()


def test_a_taken_port_is_one_clear_sentence() -> None:
    with bind("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(AddressInUse, match=f"Port {port} on 127.0.0.1 is taken") as told:
            ServerThread(FastAPI(), port=port).start()
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("port", [-1, 65536])
def test_what_is_no_port_is_refused(port: int) -> None:
    with pytest.raises(AddressUnavailable, match="not a port"):
        bind("127.0.0.1", port)


def test_a_certificate_that_cannot_be_read_is_told_before_anything_starts(tmp_path: Path) -> None:
    (tmp_path / "key.pem").write_text("no key")
    for certificate in [tmp_path / "absent.pem", tmp_path / "key.pem"]:
        with pytest.raises(CertificateUnusable, match="cannot be used"):
            ServerThread(FastAPI(), "0.0.0.0", tls=Tls(certificate, tmp_path / "key.pem"))


@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl to make a certificate")
def test_with_tls_other_addresses_may_be_bound_and_the_cookie_is_secure(tmp_path: Path, data_dir: Path) -> None:
    tls = Tls(tmp_path / "certificate.pem", tmp_path / "key.pem")
    make = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2"]
    names = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"]
    subprocess.run(
        [*make, *names, "-keyout", str(tls.key), "-out", str(tls.certificate)], check=True, capture_output=True
    )
    app = small_app(data_dir)
    with ServerThread(Guard(app, GuardRules()), "0.0.0.0", tls=tls) as where:
        trusted = ssl.create_default_context(cafile=str(tls.certificate))
        with httpx.Client(base_url=f"https://localhost:{where.port}", verify=trusted, trust_env=False) as http:
            response = http.get(login_url(app.state.access, ""))
            assert f"__Host-scanner_session_{where.port}=" in response.headers["set-cookie"]
            assert "; Secure" in response.headers["set-cookie"]
            assert http.get("/api/v1/whoami").json()["role"] == "admin"


def test_an_application_that_fails_to_start_is_told_and_frees_the_port() -> None:
    @asynccontextmanager
    async def failing(app: FastAPI) -> AsyncIterator[None]:
        raise RuntimeError("no record to open")
        yield

    with bind("127.0.0.1", 0) as free:
        port = free.getsockname()[1]
    with pytest.raises(ServerDidNotStart):
        ServerThread(FastAPI(lifespan=failing), port=port).start()
    bind("127.0.0.1", port).close()


def test_a_stopped_server_has_freed_its_port_and_its_thread_and_may_be_stopped_again(data_dir: Path) -> None:
    before = set(threading.enumerate())
    server = ServerThread(small_app(data_dir))
    where = server.start()
    with client(where) as http:
        assert http.get("/docs").status_code == 200
    server.stop()
    server.stop()
    assert not [thread for thread in set(threading.enumerate()) - before if thread.name == "http-server"]
    bind(where.host, where.port).close()


def test_the_url_is_one_that_can_be_opened() -> None:
    assert Listening("127.0.0.1", 80, False).url == "http://127.0.0.1:80"
    assert Listening("::1", 8000, False).url == "http://[::1]:8000"
    assert Listening("0.0.0.0", 8443, True).url == "https://127.0.0.1:8443"
