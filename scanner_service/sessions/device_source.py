"""Scanlines of one pass of a scanner on a serial port; what its driver says becomes notes of the session."""

import contextlib
import logging
import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

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
from drivers.scanline import DeviceInfo, Float64Array, Profile, SensorGeometry
from drivers.scanners.face import Happening
from drivers.scanners.native import NativeScanner
from drivers.tally import PassTally
from scanner_service.analysis.passes import PassKey
from scanner_service.sessions.lost_ends import LOST_END, lost_behind
from scanner_service.sessions.source import Sink

_LOG = logging.getLogger(__name__)


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
        """Chunks and lines: sent, stored, lost by reason; the line rate that was ordered, and that the wire carries."""
        told = {"line_rate_hz": self._request.line_rate_hz, "wire_line_rate_hz": self._scanner.most_lines_per_s}
        return self._scanner.tally().to_dict() | told

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
                if reason == "reached_end":
                    self._tell_lost_end(pass_index, sink)
                return reason in ("reached_end", "stopped", "fault")
            case _:
                tell_scanner_event(event, sink)
        return False

    def _tell_lost_end(self, pass_index: int, sink: Sink) -> None:
        """Say where lines are missing behind the last one that came."""
        told = (tally for (_, index), tally in self._scanner.tally().passes.items() if index == pass_index)
        lost = sum(sum(tally.lines.lost.values()) for tally in told)
        found = lost_behind(self._next_mm, self._request.end_mm, self._step_mm, lost)
        if found is not None:
            sink.note(LOST_END, {"pass_index": pass_index, **found.to_dict()})

    def _passed(self, position_mm: float) -> None:
        """A line was read at a stage position."""
        self._position_mm = position_mm
        if math.isfinite(position_mm):
            self._next_mm = position_mm + self._step_mm

    @property
    def _step_mm(self) -> float:
        """From one line to the next, negative where the stage goes down."""
        return math.copysign(self._request.line_spacing_mm, self._request.end_mm - self._request.start_mm)

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
