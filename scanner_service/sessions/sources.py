"""Where a session's scanlines come from: a device on a port, a recorded file, or lines pushed by a client.

A source runs its own thread and hands frozen scanlines to a `Sink`; it knows no map, no record and no client.
"""

import contextlib
import logging
import math
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from drivers.errors import DriverError
from drivers.protocols.scanner_events import (
    Advice,
    ClockJumped,
    Disconnected,
    OtherDevice,
    PassEnded,
    PassNotResumed,
    PassResumed,
    Rebooted,
    Reconnected,
    ScannerEvent,
)
from drivers.rig import Rig
from drivers.scanline import DeviceInfo, Float64Array, Profile, Scanline, SensorGeometry
from drivers.scanners.face import Happening
from drivers.scanners.native import NativeScanner
from scanner_service.analysis.intake import StoredLine
from scanner_service.sessions.errors import SourceUnusable
from scanner_service.storage.errors import RecordError

_LOG = logging.getLogger(__name__)


class Sink(Protocol):
    """What a source may tell its session."""

    def line(self, line: Scanline | StoredLine) -> None:
        """A scanline, or one out of a record; waits while the session is busy."""

    def note(self, kind: str, details: dict[str, Any]) -> None:
        """Something happened: `interrupted`, `reconnected`, `resumed`, `not_resumed`, `rebooted`,
        `clock_jumped`, `advice`, `pass_ended`."""

    def ended(self, failure: str | None) -> None:
        """Nothing more will come; `failure` says why when that was not planned."""


class Source(Protocol):
    """A place where scanlines come from.

    `geometry` is the scanner's optics and `towards_sensor` (3,) the direction of its z axis in the part frame; None
    when they are not known.
    """

    geometry: SensorGeometry | None
    towards_sensor: Float64Array | None

    def start(self, sink: Sink) -> None:
        """Begin to deliver; raises SourceUnusable or a DriverError when that cannot be done."""

    def stop(self) -> None:
        """Stop delivering and let go of everything; idempotent."""

    def tally(self) -> dict[str, Any] | None:
        """What the driver counted, None for a source without a wire."""

    def progress(self) -> float | None:
        """Share of the work that is done, None when the end is not known."""


@dataclass(frozen=True, slots=True)
class PassRequest:
    """One pass of the stage, from `start_mm` to `end_mm`, lines `line_spacing_mm` apart."""

    line_spacing_mm: float
    start_mm: float
    end_mm: float
    line_rate_hz: float


class DeviceSource:
    """One pass of a scanner on a serial port, placed on the part by a rig."""

    def __init__(self, scanner: NativeScanner, rig: Rig, request: PassRequest, info: DeviceInfo) -> None:
        self.geometry: SensorGeometry | None = info.geometry
        self.towards_sensor: Float64Array | None = rig.part_from_sensor(0.0).rotate(np.array([0.0, 0.0, 1.0]))
        self.info = info
        self._scanner = scanner
        self._rig = rig
        self._request = request
        self._position_mm = request.start_mm
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, sink: Sink) -> None:
        """Start the pass on the device and pump its events to the sink."""
        request = self._request
        self._scanner.start_pass(
            request.line_spacing_mm, request.start_mm, request.end_mm, request.line_rate_hz, resume=True
        )
        self._thread = threading.Thread(target=self._pump, args=(sink,), name="device-source", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop the pass, switch the laser off and close the port."""
        was_stopping = self._stopping.is_set()
        self._stopping.set()
        if self._thread is None:  # never started: nobody else lets go of the port
            self._scanner.exit()
            return
        if not was_stopping:
            with contextlib.suppress(DriverError):  # the device may be gone: then there is nothing left to stop
                self._scanner.stop_pass()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def tally(self) -> dict[str, Any] | None:
        """Chunks and lines: sent, stored, lost by reason."""
        return self._scanner.tally().to_dict()

    def progress(self) -> float | None:
        """Share of the travel that the stage has covered."""
        span = self._request.end_mm - self._request.start_mm
        return min(1.0, max(0.0, (self._position_mm - self._request.start_mm) / span)) if span else None

    def _pump(self, sink: Sink) -> None:
        failure: str | None = None
        is_over = False
        try:
            while not is_over:
                events = self._scanner.events(0.1)
                if not events and self._stopping.is_set():
                    break
                for event in events:
                    if isinstance(event, PassNotResumed):
                        failure, is_over = event.reason, True
                    is_over = self._pass_on(event, sink) or is_over
        except DriverError as error:
            failure = str(error)
        except Exception as error:  # noqa: BLE001 - the thread's loop: the laser goes off and the session is told
            _LOG.exception("reading the scanner stopped")
            failure = f"reading the scanner stopped by an internal fault: {error}"
        self._scanner.exit()
        sink.ended(failure)

    def _pass_on(self, event: Happening, sink: Sink) -> bool:
        """Tell the sink of one event; True when the pass is over."""
        match event:
            case Profile():
                self._position_mm = event.position_mm
                sink.line(self._rig.place(event))
            case PassEnded(pass_index=pass_index, reason=reason):
                sink.note("pass_ended", {"pass_index": pass_index, "reason": reason})
                return reason in ("reached_end", "stopped", "fault")
            case _:
                tell_scanner_event(event, sink)
        return False


def tell_scanner_event(event: ScannerEvent, sink: Sink) -> None:
    """Tell the sink what happened to a scanner, but for the end of its pass."""
    match event:
        case Disconnected(reason=reason):
            sink.note("interrupted", {"reason": reason})
        case OtherDevice(expected_id=expected, found_id=found):
            sink.note("interrupted", {"reason": f"on its port scanner {found} answers instead of {expected}"})
        case Reconnected(gap_s=gap_s, streaming=streaming):
            sink.note("reconnected", {"gap_s": gap_s, "streaming": streaming})
            if streaming:
                sink.note("resumed", {})
        case PassResumed(pass_index=pass_index, from_mm=from_mm):
            sink.note("resumed", {"pass_index": pass_index, "from_mm": from_mm})
        case PassNotResumed(reason=reason):
            sink.note("not_resumed", {"reason": reason})
        case Rebooted(old_boot_id=old, new_boot_id=new):
            sink.note("rebooted", {"old_boot_id": old, "new_boot_id": new})
        case ClockJumped(count=count):
            sink.note("clock_jumped", {"count": count})
        case Advice(text=text):
            sink.note("advice", {"text": text})


class ReplaySource:
    """Recorded scanlines, played as fast as they are taken or at `speed` times the pace of their device times.

    `accounts` is what the file held and what of it could not be used, `line_count` how many lines there are. Raises
    SourceUnusable when `speed` is not a pace.
    """

    def __init__(
        self,
        lines: Iterable[Scanline] | Iterable[StoredLine],
        line_count: int,
        accounts: dict[str, Any] | None = None,
        speed: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if speed is not None and not (math.isfinite(speed) and speed > 0):
            raise SourceUnusable(f"the speed of a replay must be greater than 0, not {speed}")
        self.geometry: SensorGeometry | None = None
        self.towards_sensor: Float64Array | None = None
        self._lines = lines
        self._line_count = line_count
        self._accounts = accounts
        self._speed = speed
        self._clock = clock
        self._played = 0
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, sink: Sink) -> None:
        """Begin to play."""
        self._thread = threading.Thread(target=self._play, args=(sink,), name="replay-source", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop playing."""
        self._stopping.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def tally(self) -> dict[str, Any] | None:
        """What the file held, and what of it could not be used."""
        return self._accounts

    def progress(self) -> float | None:
        """Share of the lines that were played."""
        return self._played / self._line_count if self._line_count else 1.0

    def _play(self, sink: Sink) -> None:
        begun_s = self._clock()
        first_s: float | None = None
        failure: str | None = None
        try:
            for line in self._lines:
                first_s = line.device_time_s if first_s is None else first_s
                if self._speed is not None:
                    due_s = (line.device_time_s - first_s) / self._speed
                    self._stopping.wait(max(0.0, due_s - (self._clock() - begun_s)))
                if self._stopping.is_set():
                    break
                sink.line(line)
                self._played += 1
            else:
                self._line_count = self._played  # a record may hold lines of withdrawn passes, which are not played
        except RecordError as error:
            failure = str(error)
        except Exception as error:  # noqa: BLE001 - the thread's loop: the session is told, or it would never end
            _LOG.exception("the replay stopped")
            failure = f"the replay stopped by an internal fault: {error}"
        sink.ended(failure)


class SpentSource:
    """The source of a session that was reopened from the record: what it had is stored, nothing more comes."""

    geometry: SensorGeometry | None = None
    towards_sensor: Float64Array | None = None

    def start(self, sink: Sink) -> None:
        """Cannot be started again."""
        raise SourceUnusable("this session was reopened from the record; create another one to scan again")

    def stop(self) -> None:
        """Nothing to let go of."""

    def tally(self) -> dict[str, Any] | None:
        """What the driver counted is in the record's events."""
        return None

    def progress(self) -> float | None:
        """Everything that was stored is there."""
        return 1.0


class PushSource:
    """Lines that a client pushes through the session itself: nothing to run, nothing that ends by itself."""

    geometry: SensorGeometry | None = None
    towards_sensor: Float64Array | None = None

    def start(self, sink: Sink) -> None:
        """Nothing to begin."""

    def stop(self) -> None:
        """Nothing to let go of."""

    def tally(self) -> dict[str, Any] | None:
        """There is no wire."""
        return None

    def progress(self) -> float | None:
        """The end is not known."""
        return None
