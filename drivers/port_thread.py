"""The one thread that reads and writes a port, and opens it again when it is lost; knows neither who talks nor what."""

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable

from drivers.errors import PortError, PortStalled
from drivers.port import Port

_READ_S = 0.02
_LATE_S = 0.1
"""Bytes that waited longer than this, beyond the time for which a reading waits, waited for this computer."""
_REOPEN_S = 0.1
_STALL_S = 1.0


class PortThread(ABC):
    """A port over all its pullings-out, from `_begin` to `close`.

    `changed` guards what the methods below touch, which are called with it held unless they say otherwise. `failure` is
    what ended the thread. `late_reads` counts readings that came so late that a device may have dropped what it could
    not get rid of, and `largest_pause_s` is the longest time from one reading to the next.
    """

    def __init__(self, changed: threading.Condition, clock: Callable[[], float]) -> None:
        self._changed = changed
        self._clock = clock
        self.failure: Exception | None = None
        self.late_reads = 0
        self.largest_pause_s = 0.0
        self._read_s = clock()  # when the latest reading ended
        self._stalled_s: float | None = None
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    # ---- what the two ends of a wire have of their own ------------------------------------------------------------

    @abstractmethod
    def _talk(self, port: Port, data: bytes) -> None:
        """Take what was read and send what is due; the lock is not held."""

    @abstractmethod
    def _opened(self, now_s: float) -> None:
        """A new link is there."""

    @abstractmethod
    def _lost(self, reason: str, now_s: float) -> bool:
        """The link is gone; True when it is worth waiting for."""

    @abstractmethod
    def _open_again(self) -> Port:
        """Open the port once more; raises PortError while it is gone. The lock is not held."""

    def _still_gone(self, now_s: float) -> None:  # noqa: B027 - only some have time-outs that run on meanwhile
        """The port could not be opened again yet."""

    # ---- the thread -----------------------------------------------------------------------------------------------

    def _begin(self, port: Port, name: str) -> None:
        """Tell that the link is there, and start the thread."""
        with self._changed:
            self._read_s = self._clock()
            self._opened(self._read_s)
        self._thread = threading.Thread(target=self._run, args=(port,), name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, which closes the port."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self, port: Port | None) -> None:
        try:
            while not self._closing.is_set():
                try:
                    if port is None:
                        port = self._reopen()
                        continue
                    self._talk(port, self._read(port))
                except PortError as error:
                    if port is not None:
                        port.close()
                    port = None
                    if not self._survives(error):
                        return
        except Exception as failure:  # noqa: BLE001 - the thread's loop: whoever waits must be told
            with self._changed:
                self.failure = failure
                self._changed.notify_all()
        finally:
            if port is not None:
                port.close()

    def _read(self, port: Port) -> bytes:
        """What has come; how long it waited beyond the time for which a reading waits is kept."""
        data = port.read(_READ_S)
        now_s = self._clock()
        pause_s, self._read_s = now_s - self._read_s, now_s
        if data:  # where nothing waited nobody was late
            self.largest_pause_s = max(self.largest_pause_s, pause_s)
            self.late_reads += pause_s > _READ_S + _LATE_S
        return data

    def _watch_stall(self, path: str, written: int, now_s: float) -> None:
        """Raise PortStalled when the port has taken nothing for a second."""
        if written:
            self._stalled_s = None
        elif self._stalled_s is None:
            self._stalled_s = now_s
        elif now_s - self._stalled_s > _STALL_S:
            raise PortStalled(path, f"{path} takes no more bytes; check cable and power")

    def _survives(self, error: PortError) -> bool:
        """Tell of a lost link; True when it is worth waiting for."""
        with self._changed:
            self._stalled_s = None
            waits = self._lost(str(error), self._clock())
            if not waits:
                self.failure = error
            self._changed.notify_all()
        return waits

    def _reopen(self) -> Port | None:
        """Wait a little and try once."""
        self._closing.wait(_REOPEN_S)
        try:
            port = self._open_again()
        except PortError:
            with self._changed:
                self._still_gone(self._clock())
                self._changed.notify_all()
            return None
        with self._changed:
            self._read_s = self._clock()
            self._opened(self._read_s)
        return port
