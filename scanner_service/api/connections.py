"""How long a connection may keep the service waiting: for headers, for the rest of a body, for being read from.

uvicorn has no such deadlines: half a request stays open for ever, and who never reads stays for a minute. These two
protocols add them with timers of the event loop; they know bytes and buffers, no request's meaning.
"""

import asyncio
from dataclasses import dataclass

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol


@dataclass(frozen=True, slots=True)
class Deadlines:
    """Seconds: `headers_s` for all headers of a request from its first byte or the connection's start; `send_s` for
    a client that does not read, from the moment the send buffer is full until it has drained."""

    headers_s: float = 5.0
    send_s: float = 10.0


class _Timer:
    """One deadline at a time on a transport; when it passes, `parting` is written and the connection ends."""

    def __init__(self, seconds: float, parting: bytes = b"") -> None:
        self._seconds = seconds
        self._parting = parting
        self._handle: asyncio.TimerHandle | None = None

    def arm(self, transport: asyncio.Transport) -> None:
        if self._handle is None and not transport.is_closing():
            self._handle = asyncio.get_running_loop().call_later(self._seconds, self._end, transport)

    def cancel(self) -> None:
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None

    def _end(self, transport: asyncio.Transport) -> None:
        self._handle = None
        if self._parting and not transport.is_closing():
            transport.write(self._parting)
            transport.close()
        else:
            transport.abort()


_TOO_SLOW = b"HTTP/1.1 408 Request Timeout\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


class PunctualHttp(H11Protocol):
    """uvicorn's h11 protocol with deadlines; a subclass made by `protocols` carries them."""

    deadlines = Deadlines()
    max_connections: int | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the clock: the first request's headers are due."""
        self._headers_due = _Timer(self.deadlines.headers_s, _TOO_SLOW)
        self._send_due = _Timer(self.deadlines.send_s)
        super().connection_made(transport)
        self._headers_due.arm(transport)

    def data_received(self, data: bytes) -> None:
        """Stop the clock once a request is whole up to its body; start it again with the next one's first byte."""
        super().data_received(data)
        headers_missing = self.conn.their_state is h11.IDLE
        # The answer is out and the client is still sending its body: it is drained, but not for ever.
        draining = self.conn.their_state is h11.SEND_BODY and self.conn.our_state is h11.DONE
        if headers_missing or draining:
            self._headers_due.arm(self.transport)
        else:
            self._headers_due.cancel()

    def on_response_complete(self) -> None:
        """An answer is out; part of the next request may be here already, and then its clock runs."""
        super().on_response_complete()
        begun = bool(self.conn.trailing_data[0])
        if self.conn.their_state is h11.IDLE and begun:
            self._headers_due.arm(self.transport)

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Hand the connection over, unless there are too many: uvicorn's own limit does not see WebSockets."""
        self._headers_due.cancel()
        self._send_due.cancel()
        if self.max_connections is not None and len(self.connections) > self.max_connections:
            self.transport.write(b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nContent-Length: 0\r\n\r\n")
            self.transport.close()
            return
        super().handle_websocket_upgrade(event)

    def pause_writing(self) -> None:
        """The send buffer is full."""
        super().pause_writing()
        self._send_due.arm(self.transport)

    def resume_writing(self) -> None:
        """The send buffer has drained."""
        self._send_due.cancel()
        super().resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """No timer outlives its connection."""
        self._headers_due.cancel()
        self._send_due.cancel()
        super().connection_lost(exc)


class PunctualWebSocket(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket protocol with a deadline for clients that do not read."""

    deadlines = Deadlines()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Called when the request has been upgraded."""
        self._send_due = _Timer(self.deadlines.send_s)
        super().connection_made(transport)

    def pause_writing(self) -> None:
        """The send buffer is full."""
        super().pause_writing()
        self._send_due.arm(self.transport)

    def resume_writing(self) -> None:
        """The send buffer has drained."""
        self._send_due.cancel()
        super().resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """No timer outlives its connection."""
        self._send_due.cancel()
        super().connection_lost(exc)


def protocols(deadlines: Deadlines, max_connections: int) -> tuple[type[asyncio.Protocol], type[asyncio.Protocol]]:
    """The HTTP and the WebSocket protocol with these deadlines, as uvicorn takes them: classes."""
    http = type("PunctualHttp", (PunctualHttp,), {"deadlines": deadlines, "max_connections": max_connections})
    websocket = type("PunctualWebSocket", (PunctualWebSocket,), {"deadlines": deadlines})
    return http, websocket
