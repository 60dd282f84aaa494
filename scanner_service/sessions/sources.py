"""Where a session's scanlines come from: a device on a port, a recorded file, or lines pushed by a client.

A source runs its own thread and hands frozen scanlines to a `Sink`; it knows no map, no record and no client.
"""

import contextlib
import logging
import math
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

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
from drivers.tally import PassTally
from scanner_service.analysis.intake import StoredLine
from scanner_service.analysis.passes import PassKey
from scanner_service.sessions.errors import SourceUnusable
from scanner_service.sessions.left_regions import LeftRegions
from scanner_service.storage.errors import RecordError

_LOG = logging.getLogger(__name__)


class Sink(Protocol):
    """What a source may tell its session."""

    def line(self, line: Scanline | StoredLine) -> None:
        """A scanline, or one out of a record; waits while the session is busy."""

    def note(self, kind: str, details: dict[str, Any]) -> None:
        """Something happened: `interrupted`, `held`, `reconnected`, `resumed`, `not_resumed`, `rebooted`,
        `clock_jumped`, `advice`, `pass_ended`.

        `held`: the source goes on only when its `resume` is called.
        """

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


@runtime_checkable
class Pausable(Protocol):
    """A source that can be held and go on."""

    def pause(self) -> None:
        """Deliver nothing more until `resume`; raises a DriverError when the device does not obey."""

    def resume(self) -> None:
        """Go on where it was held; raises a DriverError when that cannot be done: it is held still."""


@runtime_checkable
class OnAWire(Protocol):
    """A source whose driver keeps an account of each pass; `info` says which scanner it reads."""

    info: DeviceInfo

    def pass_tallies(self) -> Mapping[PassKey, PassTally]:
        """Chunks and lines of each pass."""


@runtime_checkable
class OnPorts(Protocol):
    """A source that holds serial ports from its making until it is stopped or at its end."""

    ports: tuple[str, ...]
    """As the user names them."""


@dataclass(frozen=True, slots=True)
class PassRequest:
    """One pass of the stage, from `start_mm` to `end_mm`, lines `line_spacing_mm` apart.

    `rearm`: after an interruption that was longer than the device's dead-man the laser is switched on again and the
    pass goes on by itself; otherwise it is held until somebody says so.
    """

    line_spacing_mm: float
    start_mm: float
    end_mm: float
    line_rate_hz: float
    rearm: bool = False


class DeviceSource:
    """One pass of a scanner on a serial port, placed on the part by a rig."""

    def __init__(self, scanner: NativeScanner, rig: Rig, request: PassRequest, info: DeviceInfo) -> None:
        self.geometry: SensorGeometry | None = info.geometry
        self.towards_sensor: Float64Array | None = rig.part_from_sensor(0.0).rotate(np.array([0.0, 0.0, 1.0]))
        self.info = info
        self.ports = (scanner.port_path,)
        self._scanner = scanner
        self._rig = rig
        self._request = request
        self._position_mm = request.start_mm
        self._next_mm = request.start_mm  # where a pass that is held would go on
        self._pausing = threading.Event()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, sink: Sink) -> None:
        """Start the pass on the device and pump its events to the sink."""
        request = self._request
        self._scanner.start_pass(
            request.line_spacing_mm, request.start_mm, request.end_mm, request.line_rate_hz, resume=request.rearm
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

    def pause(self) -> None:
        """Stop stage and laser; what was measured until then is delivered."""
        self._pausing.set()
        try:
            self._scanner.stop_pass()
        except DriverError:
            self._pausing.clear()
            raise

    def resume(self) -> None:
        """Switch the laser on and start the rest of the pass behind the last line, as a new pass of the device."""
        request = self._request
        self._pausing.clear()
        self._scanner.start_pass(
            request.line_spacing_mm, self._next_mm, request.end_mm, request.line_rate_hz, resume=request.rearm
        )

    def tally(self) -> dict[str, Any] | None:
        """Chunks and lines: sent, stored, lost by reason."""
        return self._scanner.tally().to_dict()

    def pass_tallies(self) -> Mapping[PassKey, PassTally]:
        """See `OnAWire`."""
        device_id = self.info.device_id
        return {(device_id, boot, index): told for (boot, index), told in self._scanner.tally().passes.items()}

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
                self._passed(event.position_mm)
                sink.line(self._rig.place(event))
            case PassEnded(pass_index=pass_index, reason=reason):
                sink.note("pass_ended", {"pass_index": pass_index, "reason": reason})
                if reason == "stopped" and self._pausing.is_set() and not self._stopping.is_set():
                    return self._is_complete()
                if reason in ("dead_man", "rebooted") and not self._request.rearm:
                    if self._is_complete():
                        return True
                    sink.note("held", {"reason": reason, "from_mm": self._next_mm})
                    return False
                return reason in ("reached_end", "stopped", "fault")
            case _:
                tell_scanner_event(event, sink)
        return False

    def _passed(self, position_mm: float) -> None:
        """A line was read at a stage position."""
        request = self._request
        self._position_mm = position_mm
        if math.isfinite(position_mm):
            self._next_mm = position_mm + math.copysign(request.line_spacing_mm, request.end_mm - request.start_mm)

    def _is_complete(self) -> bool:
        """True when the last line of the pass has been read: there is no rest to go on with."""
        request = self._request
        return (request.end_mm - self._next_mm) * (request.end_mm - request.start_mm) < 0


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

    `accounts` is what the file held and what of it could not be used, `line_count` how many lines there are.
    `let_go` is called, perhaps twice, when no more of them will be read; `left` are the regions that another playing
    of the same lines left. Raises SourceUnusable when `speed` is not a
    pace.
    """

    def __init__(
        self,
        lines: Iterable[Scanline] | Iterable[StoredLine],
        line_count: int,
        accounts: dict[str, Any] | None = None,
        speed: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        let_go: Callable[[], None] = lambda: None,
    ) -> None:
        if speed is not None and not (math.isfinite(speed) and speed > 0):
            raise SourceUnusable(f"the speed of a replay must be greater than 0, not {speed}")
        self.geometry: SensorGeometry | None = None
        self.towards_sensor: Float64Array | None = None
        self.left: LeftRegions | None = None
        self._lines = lines
        self._line_count = line_count
        self._accounts = accounts
        self._speed = speed
        self._clock = clock
        self._let_go = let_go
        self._played = 0
        self._going = threading.Event()
        self._going.set()
        self._held_s = 0.0
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, sink: Sink) -> None:
        """Begin to play."""
        self._thread = threading.Thread(target=self._play, args=(sink,), name="replay-source", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop playing."""
        self._stopping.set()
        self._going.set()
        if self._thread is None:
            self._let_go()
        elif self._thread is not threading.current_thread():
            self._thread.join()

    def pause(self) -> None:
        """Hold the replay."""
        self._going.clear()

    def resume(self) -> None:
        """Play on."""
        self._going.set()

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
                self._wait_while_held()
                if self._speed is not None:
                    due_s = (line.device_time_s - first_s) / self._speed + self._held_s
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
        self._let_go()
        sink.ended(failure)

    def _wait_while_held(self) -> None:
        if not self._going.is_set():
            held_s = self._clock()
            self._going.wait()
            self._held_s += self._clock() - held_s


class SpentSource:
    """The source of a session that was reopened from the record: what it had is stored, nothing more comes.

    `geometry` and `towards_sensor` are those of the source that it had.
    """

    def __init__(
        self,
        geometry: SensorGeometry | None = None,
        towards_sensor: Float64Array | None = None,
    ) -> None:
        self.geometry = geometry
        self.towards_sensor = towards_sensor

    def start(self, sink: Sink) -> None:
        """Cannot be started again."""
        raise SourceUnusable("this session was reopened from the record; create another one to scan again")

    def stop(self) -> None:
        """Nothing to let go of."""

    def tally(self) -> dict[str, Any] | None:
        """There is no wire any more; what the driver had counted is in the record."""
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

    def pause(self) -> None:
        """Nothing to hold: the session refuses lines."""

    def resume(self) -> None:
        """Nothing to go on with."""

    def tally(self) -> dict[str, Any] | None:
        """There is no wire."""
        return None

    def progress(self) -> float | None:
        """The end is not known."""
        return None
