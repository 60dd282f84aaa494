"""A scanner that speaks the native protocol, on a serial port: enter, start, events, exit; decides no policy.

The conversation itself is `drivers.protocols.native_host`, which knows no port; the port, the thread that reads it and
the bounded queue behind it are `link.py`.
"""

import math
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from drivers.errors import (
    DriverError,
    PassRefused,
    ProtocolUnsupported,
    ScannerNotConnected,
    ScannerRefused,
    ScannerSilent,
    ScannerTimeout,
)
from drivers.patience import wait_patiently
from drivers.protocols.native import line_bytes
from drivers.protocols.native_host import NativeHost, Phase
from drivers.protocols.native_messages import PROTOCOL_VERSION, AckStatus, Start
from drivers.protocols.native_requests import PassPlan, Request, describe_failure
from drivers.scanline import DeviceInfo
from drivers.scanners.face import Happening
from drivers.scanners.link import Inbox, Link, Wire
from drivers.tally import Tally

_ENTER_S = 4.0
_EXIT_S = 1.0
_END_S = 5.0
_BITS_PER_BYTE = 10


class NativeScanner:
    """One scanner on one port.

    A thread of its own reads, stamps and parses, and never waits for anybody: when `queue_lines` lines have not been
    fetched, further ones are lost and counted as `host_overflow`. The thread also holds the device's dead-man off while
    a pass is on or the laser was switched on, and reopens a lost port about every 0.1 s.

    Parameters
    ----------
    port_path : the tty, an absolute path; links such as those in /dev/serial/by-id are followed anew at each opening.
    baud_rate : bits per second.
    clock : seconds that never run backwards; it stamps the arrival of lines.
    queue_lines : lines that may wait to be fetched by `events`.
    """

    def __init__(
        self,
        port_path: str,
        baud_rate: int,
        *,
        clock: Callable[[], float] = time.monotonic,
        queue_lines: int = 4096,
    ) -> None:
        self._path = port_path
        self._baud_rate = baud_rate
        self._clock = clock
        self._changed = threading.Condition()  # guards everything below
        self._inbox = Inbox(queue_lines)
        self._host = NativeHost(self._inbox.deliver, self._inbox.tell)
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
        """Open the port, stop whatever an earlier program left running, and ask who is there.

        Raises
        ------
        PortError : when the port cannot be opened, or is lost meanwhile.
        ScannerSilent : when nothing intelligible answers.
        ProtocolUnsupported : when the device speaks another version.
        """
        if self._link is not None:
            raise DriverError(f"{self._path} has been entered already; exit first")
        self._host = host = NativeHost(self._inbox.deliver, self._inbox.tell)
        self._link = self._latest = link = Link(
            self._path, host, self._changed, self._clock, lambda: Wire(self._baud_rate)
        )
        with self._changed:
            wait_patiently(
                self._changed,
                lambda: host.stream is not None or host.other_version is not None or link.failure is not None,
                _ENTER_S,
            )
            stream, version, failure = host.stream, host.other_version, link.failure
        if stream is not None:
            return stream.info
        self.exit()
        if failure is not None:
            raise failure
        if version is not None:
            raise ProtocolUnsupported(
                f"the scanner on {self._path} speaks version {version} of the protocol, this driver version "
                f"{PROTOCOL_VERSION}; update the older of the two"
            )
        raise ScannerSilent(self._describe_silence(host.heard_bytes))

    def start_pass(
        self, line_spacing_mm: float, start_mm: float, end_mm: float, line_rate_hz: float, *, resume: bool = True
    ) -> int:
        """Switch the laser on and start a pass from `start_mm` to `end_mm` of the stage; return its index.

        The device switches the laser off again when the pass ends. With `resume`, a pass that a dead-man or a reboot
        interrupted goes on behind the last line that was read, as a new pass of the device: **the laser is then
        switched on again without a further command**, even when a cable is plugged in only much later. Without it the
        laser stays off. A pass that was stopped is never resumed.

        Raises
        ------
        ValueError : when a value cannot be a pass.
        ScannerRefused, ScannerTimeout, ScannerNotConnected : when the device does not do it.
        PassRefused : when it cannot.
        """
        if not (line_spacing_mm > 0 and line_rate_hz > 0):
            raise ValueError(
                f"line spacing and line rate must be greater than 0, not {line_spacing_mm} mm and {line_rate_hz} Hz"
            )
        plan = PassPlan(line_spacing_mm, start_mm, end_mm, line_rate_hz, resume)
        with self._changed:
            if self._host.plan is not None:
                raise ScannerRefused(f"a pass is running on {self._path}; stop it first")
        self.laser(True)
        try:
            self._command(lambda: self._host.start(plan, self._clock()))
        except DriverError:
            self._switch_off()
            raise
        return plan.index or 0

    @property
    def port_path(self) -> str:
        """The port as it was named."""
        return self._path

    @property
    def most_lines_per_s(self) -> float:
        """Lines a second for which the wire has time at its baud rate; infinite before the scanner is entered."""
        with self._changed:
            stream = self._host.stream
        bytes_per_s = self._baud_rate / _BITS_PER_BYTE
        return math.inf if stream is None else bytes_per_s / line_bytes(stream.info.points_per_line)

    def stop_pass(self) -> None:
        """Stop the pass and switch the laser off; returns when its last lines and `PassEnded` are in `events`.

        Raises
        ------
        ScannerTimeout, ScannerNotConnected : when the device does not answer; its dead-man then stops it.
        """
        host = self._host
        with self._changed:
            if host.phase is not Phase.UP:
                host.abandon(self._clock())
        self._command(lambda: host.stop(self._clock()))
        with self._changed:
            wait_patiently(
                self._changed,
                lambda: host.plan is None or host.phase is not Phase.UP or self._failure is not None,
                _END_S,
            )
            if host.plan is not None:
                host.abandon(self._clock())
                raise ScannerTimeout(f"the scanner on {self._path} stopped, but did not report the end of its pass")

    def laser(self, on: bool) -> None:
        """Switch the laser on, and keep it on, or off, which also ends a pass.

        Raises
        ------
        ScannerRefused, ScannerTimeout, ScannerNotConnected : when the device does not do it.
        """
        self._command(lambda: self._host.arm(on, self._clock()))

    @property
    def laser_on(self) -> bool | None:
        """The device's last word on its laser; None is unknown, and to be shown as on."""
        with self._changed:
            return self._host.laser_on

    @property
    def is_connected(self) -> bool:
        """True while the device answers."""
        with self._changed:
            return self._host.phase is Phase.UP

    def events(self, timeout_s: float) -> list[Happening]:
        """Return the lines and events since the last call, in order; waits at most `timeout_s` for the first.

        Raises
        ------
        Exception : what has ended the reading thread, if something did.
        """
        with self._changed:
            self._changed.wait_for(lambda: len(self._inbox) or self._failure is not None, timeout_s)
            if self._failure is not None and not len(self._inbox):
                raise self._failure
            return self._inbox.take()

    def tally(self) -> Tally:
        """Return the exact accounts up to now, over all boots since `enter`."""
        with self._changed:
            stream = self._host.stream
            tally = stream.tally() if stream is not None else Tally()
            return tally if self._latest is None else self._latest.with_reading(tally)

    def exit(self) -> None:
        """Stop the pass, switch the laser off, close the port; never raises, and returns within about 2 s."""
        link = self._link
        if link is None:
            return
        self._switch_off()
        link.close()
        self._link = None

    def _switch_off(self) -> None:
        """Ask for laser off and stop, wait a little; where no answer comes the dead-man does it."""
        with self._changed:
            host, now_s = self._host, self._clock()
            if host.phase is not Phase.UP or self._failure is not None:
                host.abandon(now_s)
                return
            stop, off = host.stop(now_s), host.arm(False, now_s)
            wait_patiently(
                self._changed,
                lambda: (stop.done and off.done) or host.phase is not Phase.UP or self._failure is not None,
                _EXIT_S,
            )
            host.abandon(self._clock())

    def _command(self, ask: Callable[[], Request]) -> None:
        with self._changed:
            if self._link is None or self._host.phase is not Phase.UP:
                raise ScannerNotConnected(f"the scanner on {self._path} is not connected; wait until it is back")
            request = ask()
            self._changed.wait_for(lambda: request.done or self._failure is not None)
            if self._failure is not None:
                raise self._failure
        if request.ack is None:
            raise ScannerTimeout(f"{describe_failure(request)}; check cable and power of {self._path}")
        if not request.ok:
            is_order = isinstance(request.command, Start) and request.ack.result is AckStatus.BAD_VALUE
            raise (PassRefused if is_order else ScannerRefused)(describe_failure(request))

    def _describe_silence(self, heard_bytes: int) -> str:
        where = f"{self._path} at {self._baud_rate} baud"
        if heard_bytes:
            return f"what comes from {where} is not this protocol ({heard_bytes} bytes); try the scanner's other rates"
        return f"no scanner answers on {where}; check its power, the cable, the path and the rate"

    @property
    def _failure(self) -> Exception | None:
        """What has ended the reading thread."""
        return None if self._link is None else self._link.failure
