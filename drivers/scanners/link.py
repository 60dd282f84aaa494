"""A scanner's port with its thread, and the bounded queue behind it; knows no protocol and decides no policy.

The thread stamps what it reads and hands it to the host's half of a conversation, and writes what that has to say. It
never waits for whoever fetches the lines.
"""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, Protocol

from drivers.errors import PortStalled
from drivers.port import LEAVE_LINES, ModemLines, Port, lasting_path
from drivers.port_thread import PortThread
from drivers.protocols.scanner_events import ScannerEvent
from drivers.scanline import Profile
from drivers.scanners.face import Happening
from drivers.tally import Tally

_OVERRUNS_S = 1.0
_MAX_EVENTS = 1_000


class Wire(NamedTuple):
    """How the port is to be set: its rate, and DTR (None leaves it)."""

    baud_rate: int
    dtr: bool | None = None


class Host(Protocol):
    """The host's half of a conversation, as far as a link drives it."""

    @property
    def outgoing(self) -> bytearray:
        """Bytes to be sent; the link takes them out."""

    @property
    def is_met(self) -> bool:
        """True once a device has said who it is."""

    def link_opened(self, now_s: float) -> None:
        """A new link is there."""

    def link_lost(self, reason: str, now_s: float) -> None:
        """The link is gone, or given up."""

    def receive(self, data: bytes, now_s: float) -> None:
        """Bytes have come."""

    def tick(self, now_s: float) -> None:
        """Time has passed."""

    def trouble(self, now_s: float) -> str | None:
        """One sentence when the link is best opened anew."""


class Inbox:
    """Lines and events that wait to be fetched; the caller holds the lock.

    At most `queue_lines` lines wait: `deliver` says no to more. Of events at most 1,000 wait, further ones are lost.
    """

    def __init__(self, queue_lines: int) -> None:
        self._queue_lines = queue_lines
        self._queue: deque[Happening] = deque()
        self._lines_waiting = 0

    def __len__(self) -> int:
        return len(self._queue)

    def deliver(self, profile: Profile) -> bool:
        """Keep a line; False when there is no room for it."""
        if self._lines_waiting >= self._queue_lines:
            return False
        self._queue.append(profile)
        self._lines_waiting += 1
        return True

    def tell(self, event: ScannerEvent) -> None:
        """Keep an event."""
        if len(self._queue) - self._lines_waiting < _MAX_EVENTS:
            self._queue.append(event)

    def take(self) -> list[Happening]:
        """All there is."""
        happenings = list(self._queue)
        self._queue.clear()
        self._lines_waiting = 0
        return happenings


class Link(PortThread):
    """The port at `path` while it is entered, over all its pullings-out.

    `changed` guards the host and the inbox, and is notified whenever something may have come. `wire` tells how the port
    is to be set, and is asked again after every byte that the host has seen. `failure` is what ended the thread.

    Raises
    ------
    PortError : when the port cannot be opened.
    """

    def __init__(
        self,
        path: str,
        host: Host,
        changed: threading.Condition,
        clock: Callable[[], float],
        wire: Callable[[], Wire],
        lines: ModemLines = LEAVE_LINES,
    ) -> None:
        super().__init__(changed, clock)
        self._path = path
        self._host = host
        self._wire = wire
        self._lines = lines
        self.overruns = 0
        """Bytes that UART and kernel dropped, where they count them."""
        self._overruns_before = 0
        self._overruns_s = clock()
        port = Port(path, wire().baud_rate, lines)
        self._reopen_path = lasting_path(path)
        self._begin(port, f"scanner {path}")

    def with_reading(self, tally: Tally) -> Tally:
        """The accounts, with how late bytes were read, and those that nobody read in time among the damage."""
        damage = tally.damage | {"uart_overrun": self.overruns} if self.overruns else tally.damage
        return replace(tally, damage=damage, late_reads=self.late_reads, largest_pause_s=self.largest_pause_s)

    def _talk(self, port: Port, data: bytes) -> None:
        """Take what was read, set the port as the host wants it, send what is due."""
        with self._changed:
            now_s = self._clock()
            host = self._host
            host.receive(data, now_s)
            host.tick(now_s)
            trouble = host.trouble(now_s)
            if trouble is not None:
                raise PortStalled(self._path, f"{self._path}: {trouble}")
            self._set(port)
            if host.outgoing:
                written = port.write(bytes(host.outgoing))
                del host.outgoing[:written]
                self._watch_stall(self._path, written, now_s)
            if now_s - self._overruns_s >= _OVERRUNS_S:
                self._overruns_s = now_s
                self.overruns = self._overruns_before + (port.overruns() or 0)
            self._changed.notify_all()

    def _set(self, port: Port) -> None:
        wire = self._wire()
        port.set_baud_rate(wire.baud_rate)
        if wire.dtr is not None:
            port.set_dtr(wire.dtr)

    def _opened(self, now_s: float) -> None:
        self._host.link_opened(now_s)

    def _lost(self, reason: str, now_s: float) -> bool:
        """Worth waiting for unless the device was never met."""
        self._overruns_before = self.overruns
        met = self._host.is_met
        self._host.link_lost(reason, now_s)
        return met

    def _open_again(self) -> Port:
        return Port(self._reopen_path, self._wire().baud_rate, self._lines)

    def _still_gone(self, now_s: float) -> None:
        self._host.tick(now_s)
