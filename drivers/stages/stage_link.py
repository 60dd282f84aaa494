"""The port of a stage and the one thread that reads and writes it, over all pullings-out; knows no protocol."""

import threading
from collections.abc import Callable

from drivers.errors import PortError, PortStalled
from drivers.port import ModemLines, Port, lasting_path
from drivers.port_names import find_port
from drivers.protocols.stage_host import StageHost

_READ_S = 0.02
_REOPEN_S = 0.1
_STALL_S = 1.0


class StageLink:
    """The port that a name leads to, while it is entered.

    Parameters
    ----------
    port_name : a path, or `usb:VID:PID[:SERIAL]`; looked up anew at each opening, since names change at a replug.
    changed : guards the host, and is notified whenever something may have come.
    on_lost : told, with the lock held, why the link is gone and when; True when it is worth waiting for.

    Raises
    ------
    PortError : when the port cannot be opened.
    """

    def __init__(
        self,
        port_name: str,
        baud_rate: int,
        lines: ModemLines,
        host: StageHost,
        changed: threading.Condition,
        clock: Callable[[], float],
        on_lost: Callable[[str, float], bool],
    ) -> None:
        path = find_port(port_name)
        self._opens = port_name if port_name.startswith("usb:") else lasting_path(path)
        self._baud_rate = baud_rate
        self._lines = lines
        self._host = host
        self._changed = changed
        self._clock = clock
        self._on_lost = on_lost
        self.failure: Exception | None = None
        """What ended the thread."""
        self._stalled_s: float | None = None
        self._closing = threading.Event()
        port = Port(path, baud_rate, lines)
        with changed:
            host.link_opened(clock())
        self._thread = threading.Thread(target=self._run, args=(port,), name=f"stage {port_name}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, which closes the port."""
        self._closing.set()
        self._thread.join()

    def _run(self, port: Port | None) -> None:
        try:
            while not self._closing.is_set():
                try:
                    if port is None:
                        port = self._reopen()
                        continue
                    self._talk(port, port.read(_READ_S))
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

    def _talk(self, port: Port, data: bytes) -> None:
        """Take what was read, send what is due."""
        with self._changed:
            now_s = self._clock()
            host = self._host
            host.receive(data, now_s)
            host.tick(now_s)
            if host.is_silent():
                raise PortStalled(port.path, f"the stage on {port.path} has fallen silent; check cable and power")
            if len(host.outbox):
                written = port.write(host.outbox.peek())
                host.outbox.wrote(written)
                self._watch_stall(port, written, now_s)
            self._changed.notify_all()

    def _watch_stall(self, port: Port, written: int, now_s: float) -> None:
        if written:
            self._stalled_s = None
        elif self._stalled_s is None:
            self._stalled_s = now_s
        elif now_s - self._stalled_s > _STALL_S:
            raise PortStalled(port.path, f"{port.path} takes no more bytes; check cable and power")

    def _survives(self, error: PortError) -> bool:
        """Tell of a lost link; True when it is worth waiting for."""
        with self._changed:
            self._stalled_s = None
            waits = self._on_lost(str(error), self._clock())
            if not waits:
                self.failure = error
            self._changed.notify_all()
        return waits

    def _reopen(self) -> Port | None:
        """Wait a little and try the name once."""
        self._closing.wait(_REOPEN_S)
        try:
            port = Port(find_port(self._opens), self._baud_rate, self._lines)
        except PortError:
            return None
        with self._changed:
            self._host.link_opened(self._clock())
        return port
