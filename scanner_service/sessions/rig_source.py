"""A rig as a session's source: its stage is homed if that was asked, one pass is driven, its lines go to the sink."""

import contextlib
import logging
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from drivers.errors import DriverError
from drivers.pass_accounts import PassReport
from drivers.protocols.scanner_events import PassEnded
from drivers.protocols.stage_events import PositionLost, StageDisconnected, StageReconnected
from drivers.rig_description import RigDescription
from drivers.rig_limits import PassOrder
from drivers.running_rig import RigEvent, RigPassEnded, RunningRig
from drivers.scanline import DeviceInfo, Float64Array, Scanline, SensorGeometry
from drivers.stages.face import DrivenStage
from drivers.tally import PassTally
from scanner_service.analysis.passes import PassKey
from scanner_service.sessions.device_source import tell_scanner_event
from scanner_service.sessions.lost_ends import LOST_END, unseen_behind
from scanner_service.sessions.source import Sink

_LOG = logging.getLogger(__name__)
_PREPARING_LOOK_S = 0.2


@dataclass(frozen=True, slots=True)
class Preparation:
    """What comes before the pass: homing, or the user's word on where the stage is (`at_mm`), or neither."""

    home: bool = False
    at_mm: float | None = None


class RigSource:
    """One pass of a rig that is entered already.

    `description` is what the rig is made of as it stands without anybody's turn of the part; `rests_at_mm` is where the
    stage was left by a pass that was driven to its end, None where nobody knows.
    """

    def __init__(
        self,
        rig: RunningRig,
        order: PassOrder,
        info: DeviceInfo,
        preparation: Preparation,
        description: RigDescription,
    ) -> None:
        self.geometry: SensorGeometry | None = rig.limits.geometry or info.geometry
        self.towards_sensor: Float64Array | None = rig.pose_at(order.start_mm).rotate(np.array([0.0, 0.0, 1.0]))
        self.info = info
        self.description = description
        self.ports = tuple(choice.port for choice in (description.scanner, description.stage) if choice.port)
        self.is_driven = rig.is_driven
        self.rests_at_mm: float | None = None
        self._rig = rig
        self._order = order
        self._preparation = preparation
        self._position_mm = order.start_mm
        self._stopping = threading.Event()
        self._is_preparing = True
        self._thread: threading.Thread | None = None

    def start(self, sink: Sink) -> None:
        """Begin: in a thread of its own the stage is prepared and the pass is driven."""
        self._thread = threading.Thread(target=self._pump, args=(sink,), name="rig-source", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop the stage first, then the scanner, and let go of both."""
        self._stopping.set()
        self._rig.stop()
        if self._thread is None:  # never started: nobody else lets go of the ports
            self._rig.exit()
        elif self._thread is not threading.current_thread():
            while self._is_preparing and self._thread.is_alive():  # a homing may have begun behind the stop
                self._thread.join(_PREPARING_LOOK_S)
                self._rig.stop()
            self._thread.join()

    def tally(self) -> dict[str, Any] | None:
        """The scanner's accounts, and under `rig` what became of its profiles."""
        return self._rig.tally().to_dict() | {"rig": self._rig.report().to_dict()}

    def pass_tallies(self) -> Mapping[PassKey, PassTally]:
        """See `OnAWire`; what the rig left out is lost there, by its reason."""
        device_id = self.info.device_id
        return {(device_id, boot, index): told for (boot, index), told in self._rig.pass_tallies().items()}

    def progress(self) -> float | None:
        """Share of the travel that lines have been placed on."""
        span_mm = self._order.end_mm - self._order.start_mm
        return min(1.0, max(0.0, (self._position_mm - self._order.start_mm) / span_mm))

    def _pump(self, sink: Sink) -> None:
        failure: str | None = None
        try:
            try:
                self._prepare()
            finally:
                self._is_preparing = False
            if not self._stopping.is_set():
                self._rig.start(self._order)
                failure = self._follow(sink)
        except DriverError as error:
            failure = None if self._stopping.is_set() else str(error)
        except Exception as error:  # noqa: BLE001 - the thread's loop: everything stops and the session is told
            _LOG.exception("driving the rig stopped")
            failure = f"driving the rig stopped by an internal fault: {error}"
        with contextlib.suppress(DriverError):
            self._rig.exit()
        sink.ended(failure)

    def _prepare(self) -> None:
        if not self._rig.is_driven or self._stopping.is_set():
            return
        stage = cast(DrivenStage, self._rig.stage)
        if self._preparation.home:
            stage.home()
        elif self._preparation.at_mm is not None:
            stage.set_position(self._preparation.at_mm)

    def _follow(self, sink: Sink) -> str | None:
        """Pass everything on until the pass is over; return why it failed, if it did."""
        while True:
            for event in self._rig.events(0.1):
                if isinstance(event, RigPassEnded):
                    sink.note("pass_ended", {"reason": event.reason, **event.report.to_dict()})
                    if event.reason == "reached_end":
                        self._tell_lost_end(event.report, sink)
                    if event.reason == "reached_end" and event.failure is None and self.is_driven:
                        self.rests_at_mm = self._order.end_mm
                    return event.failure
                self._pass_on(event, sink)

    def _tell_lost_end(self, report: PassReport, sink: Sink) -> None:
        """Say where lines are missing behind the last one that came."""
        step_mm = np.nanmax([self._order.line_spacing_mm, abs(report.median_step_mm)])
        found = unseen_behind(self._position_mm, self._order.end_mm, float(step_mm))
        if found is not None:
            sink.note(LOST_END, found.to_dict())

    def _pass_on(self, event: RigEvent, sink: Sink) -> None:
        match event:
            case Scanline():
                self._position_mm = event.position_mm
                sink.line(event)
            case StageDisconnected(reason=reason):
                sink.note("interrupted", {"reason": reason})
            case StageReconnected(gap_s=gap_s, position_kept=position_kept):
                sink.note("reconnected", {"gap_s": gap_s, "position_kept": position_kept})
                if position_kept:
                    sink.note("resumed", {})
            case PositionLost(reason=reason):
                sink.note("position_lost", {"reason": reason})
            case RigPassEnded() | PassEnded():
                pass  # the rig tells the end of its pass itself
            case _:
                tell_scanner_event(event, sink)
