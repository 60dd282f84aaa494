"""Serves an application with uvicorn: where it listens, how much and how long it takes; knows no route.

Errors: `ServerError` - `AddressRefused`, `AddressInUse`, `AddressUnavailable`, `CertificateUnusable`,
`ServerDidNotStart`, `ServerDidNotStop`.
"""

import errno
import ipaddress
import os
import socket
import ssl
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import uvicorn
from starlette.types import ASGIApp

from scanner_service.api.connections import Deadlines, protocols

KIB = 1024
_TURN_S = 3e-4
"""For so long a thread may run on in Python while another waits for its turn; Python's own 5 ms are five scanlines."""


class ServerError(Exception):
    """The service cannot be served; the message says why and what to do."""


class AddressRefused(ServerError):
    """An address beyond this machine without TLS."""


class AddressInUse(ServerError):
    """Another process listens there."""


class AddressUnavailable(ServerError):
    """The address is not of this machine, or the port is not permitted."""


class CertificateUnusable(ServerError):
    """Certificate or key cannot be read, or do not belong together."""


class ServerDidNotStart(ServerError):
    """The application failed while starting."""


class ServerDidNotStop(ServerError):
    """The server thread was still at work when the time was up."""


@dataclass(frozen=True, slots=True)
class Tls:
    """Certificate chain and private key, PEM files."""

    certificate: Path
    key: Path


@dataclass(frozen=True, slots=True)
class ServerLimits:
    """What the server takes: see uvicorn's settings of the same meaning. Bytes and seconds.

    `ws_message_bytes` bounds what clients send, not what they get.
    """

    deadlines: Deadlines = field(default_factory=Deadlines)
    connections: int = 400
    header_bytes: int = 32 * KIB
    ws_message_bytes: int = 64 * KIB
    keep_alive_s: int = 5
    shutdown_s: int = 5


@dataclass(frozen=True, slots=True)
class Listening:
    """Where the service can be reached: the real port, also when port 0 was asked for."""

    host: str
    port: int
    tls: bool

    @property
    def url(self) -> str:
        """For example http://127.0.0.1:8000, without a slash at the end."""
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.host, self.host)
        return f"{'https' if self.tls else 'http'}://{f'[{host}]' if ':' in host else host}:{self.port}"


def is_loopback(host: str) -> bool:
    """True for the addresses of this machine only; names other than localhost are not trusted to be."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def bind(host: str, port: int, tls: Tls | None = None) -> socket.socket:
    """A bound socket, not yet listening; the caller closes it.

    Raises
    ------
    AddressRefused : when `host` is more than this machine and there is no TLS.
    AddressInUse, AddressUnavailable
    """
    if tls is None and not is_loopback(host):
        raise AddressRefused(
            f"{host} can be reached by other machines, and keys would cross the network in the clear: give a TLS "
            f"certificate and its key, or listen on 127.0.0.1 behind a proxy that ends TLS."
        )
    if not 0 <= port < 65536:
        raise AddressUnavailable(f"{port} is not a port; ports go from 0 (any free one) to 65535.")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    bound = socket.socket(family, socket.SOCK_STREAM)
    try:
        if os.name == "posix":  # elsewhere the option would let a second process take the port
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(("127.0.0.1" if host == "localhost" else host, port))
        bound.listen(1)  # of two sockets with SO_REUSEADDR only one may listen: learn it now, not in the server
    except OSError as error:
        bound.close()
        if error.errno == errno.EADDRINUSE:
            raise AddressInUse(
                f"Port {port} on {host} is taken by another program; stop that one, or choose another --port."
            ) from error
        raise AddressUnavailable(f"Cannot listen on {host} port {port}: {error.strerror or error}.") from error
    return bound


def uvicorn_config(app: ASGIApp, tls: Tls | None = None, limits: ServerLimits | None = None) -> uvicorn.Config:
    """The settings of the server; sockets are bound by `bind` and handed over.

    Raises
    ------
    CertificateUnusable
    """
    if tls is not None:
        _check_certificate(tls)
    limits = limits or ServerLimits()
    http, websocket = protocols(limits.deadlines, limits.connections)
    return uvicorn.Config(
        app,
        http=http,
        ws=websocket,
        ws_max_size=limits.ws_message_bytes,
        ws_max_queue=16,
        ws_per_message_deflate=False,  # costs a factor of 25 in throughput on binary frames
        limit_concurrency=limits.connections,
        h11_max_incomplete_event_size=limits.header_bytes,
        timeout_keep_alive=limits.keep_alive_s,
        timeout_graceful_shutdown=limits.shutdown_s,
        backlog=256,
        server_header=False,
        proxy_headers=False,  # headers that anyone may send decide nothing
        access_log=False,  # it would hold one-time tokens
        log_config=None,  # logging is the composition root's
        workers=1,
        ssl_certfile=tls.certificate if tls else None,
        ssl_keyfile=tls.key if tls else None,
        lifespan="on",
        interface="asgi3",
    )


def serve(
    app: ASGIApp,
    host: str,
    port: int,
    tls: Tls | None = None,
    limits: ServerLimits | None = None,
    on_bound: Callable[[Listening], None] = lambda listening: None,
) -> None:
    """Serve until SIGINT or SIGTERM; `on_bound` is told where, before the first request is taken.

    Raises
    ------
    ServerError : one of its kinds, in one sentence.
    """
    sys.setswitchinterval(_TURN_S)
    config = uvicorn_config(app, tls, limits)
    with bind(host, port, tls) as bound:
        on_bound(_listening(host, bound, tls))
        server = uvicorn.Server(config)
        try:
            server.run(sockets=[bound])
        except KeyboardInterrupt:  # raised again by uvicorn after it has stopped in good order
            return
        except SystemExit as error:
            raise ServerDidNotStart("The service stopped while starting; the log says why.") from error


class ServerThread:
    """A server on its own thread, for embedding: `with ServerThread(app) as listening: ...`."""

    def __init__(
        self,
        app: ASGIApp,
        host: str = "127.0.0.1",
        port: int = 0,
        tls: Tls | None = None,
        limits: ServerLimits | None = None,
    ) -> None:
        self._config = uvicorn_config(app, tls, limits)
        self._host, self._port, self._tls = host, port, tls
        self._server: _AnnouncingServer | None = None
        self._thread: threading.Thread | None = None

    def start(self, timeout_s: float = 60.0) -> Listening:
        """Bind, start, and wait until requests are taken.

        Raises
        ------
        AddressRefused, AddressInUse, AddressUnavailable, ServerDidNotStart
        """
        if self._thread is not None:
            raise ServerDidNotStart("This server was started already; make a new one.")
        bound = bind(self._host, self._port, self._tls)
        listening = _listening(self._host, bound, self._tls)
        self._server = server = _AnnouncingServer(self._config)
        self._thread = threading.Thread(target=server.run_on, args=(bound,), name="http-server", daemon=True)
        self._thread.start()
        in_time = server.announced.wait(timeout_s)
        if not in_time or not server.started:
            server.should_exit = True
            self._thread.join(timeout_s)
            raise ServerDidNotStart(
                "The service stopped while starting; the log says why."
                if in_time
                else f"The service had not started after {timeout_s:g} s."
            )
        return listening

    def stop(self, timeout_s: float = 30.0) -> None:
        """Take no more requests, let running ones end, and wait for the thread; nothing happens when not running.

        Raises
        ------
        ServerDidNotStop
        """
        if self._server is None or self._thread is None:
            return
        self._server.should_exit = True
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise ServerDidNotStop(f"The server was still at work after {timeout_s:g} s.")

    def __enter__(self) -> Listening:
        return self.start()

    def __exit__(self, *exc_info: object) -> None:
        self.stop()


class _AnnouncingServer(uvicorn.Server):
    """Says when it takes requests, or that it never will."""

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.announced = threading.Event()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self.announced.set()

    def run_on(self, bound: socket.socket) -> None:
        try:
            self.run(sockets=[bound])
        except SystemExit:  # how uvicorn says that the application did not start; `started` stays False
            pass
        finally:
            bound.close()
            self.announced.set()


def _listening(host: str, bound: socket.socket, tls: Tls | None) -> Listening:
    return Listening(host, int(bound.getsockname()[1]), tls is not None)


def _check_certificate(tls: Tls) -> None:
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(tls.certificate, tls.key)
    except (OSError, ssl.SSLError) as error:
        raise CertificateUnusable(
            f"The certificate {tls.certificate} with the key {tls.key} cannot be used: {error.strerror or error}."
        ) from error
