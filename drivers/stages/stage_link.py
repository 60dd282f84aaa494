"""The port of a stage with its thread, found anew by its name after every pulling-out; knows no protocol."""

import threading
from collections.abc import Callable

from drivers.errors import PortStalled
from drivers.port import ModemLines, Port, lasting_path
from drivers.port_names import find_port
from drivers.port_thread import PortThread
from drivers.protocols.stage_host import StageHost


class StageLink(PortThread):
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
        super().__init__(changed, clock)
        path = find_port(port_name)
        self._opens = port_name if port_name.startswith("usb:") else lasting_path(path)
        self._baud_rate = baud_rate
        self._lines = lines
        self._host = host
        self._on_lost = on_lost
        self._begin(Port(path, baud_rate, lines), f"stage {port_name}")

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
                self._watch_stall(port.path, written, now_s)
            self._changed.notify_all()

    def _opened(self, now_s: float) -> None:
        self._host.link_opened(now_s)

    def _lost(self, reason: str, now_s: float) -> bool:
        return self._on_lost(reason, now_s)

    def _open_again(self) -> Port:
        return Port(find_port(self._opens), self._baud_rate, self._lines)
