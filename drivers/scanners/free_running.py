"""A scanner without a stage of its own, on a serial port: enter, start, events, stop, exit; knows no protocol.

The conversation is one of `drivers.protocols`, the port and its thread are `link.py`.
"""

import secrets
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self, TypeAlias

from drivers.errors import DriverError, PortError, ScannerNotConnected, ScannerSilent, ScannerTimeout
from drivers.patience import wait_patiently
from drivers.port import LEAVE_LINES, ModemLines
from drivers.protocols.conversation import Conversation, Listener, Phase, Task
from drivers.scanline import DeviceInfo
from drivers.scanners.face import Happening
from drivers.scanners.link import Inbox, Link, Wire
from drivers.tally import Tally

MakeConversation: TypeAlias = Callable[[Listener], Conversation]

_ENTER_S = 30.0
_COMMAND_S = 15.0
_EXIT_S = 1.5


class FreeRunner:
    """One free-running scanner on one port; a `FreeRunningScanner`.

    Parameters
    ----------
    port_path : the tty, an absolute path. Links are followed anew at each opening; where /dev/serial/by-id has a link
        to the same adapter, a lost port is looked for by that, since its number may have changed.
    converse : makes the conversation, of whoever listens to it.
    lines : how the modem lines are to stand.
    clock : seconds that never run backwards; it stamps the arrival of profiles.
    queue_lines : profiles that may wait to be fetched by `events`; more are lost and counted as `host_overflow`.
    """

    def __init__(
        self,
        port_path: str,
        converse: MakeConversation,
        *,
        lines: ModemLines = LEAVE_LINES,
        clock: Callable[[], float] = time.monotonic,
        queue_lines: int = 4096,
    ) -> None:
        self._path = port_path
        self._converse = converse
        self._lines = lines
        self._clock = clock
        self._queue_lines = queue_lines
        self._changed = threading.Condition()  # guards everything below
        self._inbox = Inbox(queue_lines)
        self._host: Conversation | None = None
        self._link: Link | None = None
        self._latest: Link | None = None  # also when it is closed: what it counted is asked for then

    def __enter__(self) -> Self:
        self.enter()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.exit()

    def enter(self) -> DeviceInfo:
        """Open the port, stop whatever an earlier program left running, find the rate, and ask who is there.

        Raises
        ------
        PortError : when the port cannot be opened, or is lost meanwhile.
        ScannerError : when nobody answers, or not as this scanner does.
        """
        if self._link is not None:
            raise DriverError(f"{self._path} has been entered already; exit first")
        self._inbox = Inbox(self._queue_lines)
        self._host = host = self._converse(Listener(self._inbox.deliver, self._inbox.tell, secrets.randbits(32)))
        self._link = self._latest = link = Link(
            self._path, host, self._changed, self._clock, lambda: Wire(host.baud_rate, host.dtr), self._lines
        )
        with self._changed:
            wait_patiently(self._changed, lambda: host.info is not None or link.failure is not None, _ENTER_S)
            info, failure, silence = host.info, link.failure, host.failure
        if info is not None:
            return info
        self.exit()
        if silence is not None:
            raise type(silence)(f"{self._path}: {silence}")
        if isinstance(failure, PortError):
            raise failure
        raise failure or ScannerSilent(f"nothing on {self._path} answers; check its power, the cable and the path")

    def start_profiles(self, *, resume: bool = True) -> int:
        """Switch the laser on and begin; return the pass index.

        With `resume` a link that comes back goes on by itself: **the laser is then switched on again without a further
        command**. Without it, and after `stop_profiles`, it stays off.

        Raises
        ------
        ScannerRefused, ScannerTimeout, ScannerNotConnected : when the device does not do it.
        """
        host = self._entered()
        self._await(lambda: host.start(self._clock(), resume=resume))
        return host.pass_index

    def stop_profiles(self) -> None:
        """Stop and switch the laser off; returns when the last profiles and `PassEnded` are in `events`.

        Raises
        ------
        ScannerTimeout, ScannerNotConnected : when the device does not answer.
        """
        host = self._entered()
        self._await(lambda: host.stop(self._clock()))

    @property
    def laser_on(self) -> bool | None:
        """The device's last word on its laser; None is unknown, and to be shown as on."""
        with self._changed:
            return None if self._host is None else self._host.laser_on

    @property
    def is_connected(self) -> bool:
        """True while the device answers."""
        with self._changed:
            return self._host is not None and self._host.phase is Phase.UP

    @property
    def baud_rate(self) -> int | None:
        """The rate at which the device answers; None before `enter`."""
        with self._changed:
            return None if self._host is None else self._host.baud_rate

    def events(self, timeout_s: float) -> list[Happening]:
        """Profiles and events since the last call, in order; waits at most `timeout_s` for the first.

        Raises
        ------
        Exception : what has ended the reading thread, if something did.
        """
        with self._changed:
            link = self._link
            self._changed.wait_for(lambda: len(self._inbox) or (link is not None and link.failure), timeout_s)
            if link is not None and link.failure is not None and not len(self._inbox):
                raise link.failure
            return self._inbox.take()

    def tally(self) -> Tally:
        """The exact accounts since `enter`; `uart_overrun` among the damage are bytes nobody read in time."""
        with self._changed:
            if self._host is None:
                return Tally()
            tally = self._host.tally()
            return tally if self._latest is None else self._latest.with_reading(tally)

    def exit(self) -> None:
        """Stop, switch the laser off, close the port; never raises, and returns within about 2 s."""
        host, link = self._host, self._link
        if host is None or link is None:
            return
        with self._changed:
            if host.phase is Phase.UP and link.failure is None:
                task = host.stop(self._clock())
                wait_patiently(self._changed, lambda: task.done or link.failure is not None, _EXIT_S)
        link.close()
        with self._changed:
            host.end()
            self._link = None

    def _entered(self) -> Conversation:
        if self._host is None or self._link is None:
            raise ScannerNotConnected(f"{self._path} has not been entered")
        return self._host

    def _await(self, ask: Callable[[], Task]) -> None:
        link = self._link
        with self._changed:
            task = ask()
            in_time = wait_patiently(
                self._changed, lambda: task.done or (link is not None and link.failure is not None), _COMMAND_S
            )
            if task.failure is not None:
                raise type(task.failure)(f"{self._path}: {task.failure}")
            if link is not None and link.failure is not None:
                raise link.failure
        if not in_time:
            raise ScannerTimeout(f"the scanner on {self._path} did not answer in {_COMMAND_S:g} s")
