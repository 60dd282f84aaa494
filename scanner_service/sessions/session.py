"""A live scan session: one source, one engine, one analyst, and the state that a user sees; knows no HTTP."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import replace
from typing import Any

import numpy as np

from drivers.errors import PassRefused
from drivers.scanline import Scanline
from scanner_service.analysis.intake import StoredLine
from scanner_service.analysis.passes import PassKey
from scanner_service.rescan.region import RegionStatus
from scanner_service.rescan.requirement import Requirement
from scanner_service.sessions.cadence import Cadence
from scanner_service.sessions.calibration import CALIBRATED, calibration_of
from scanner_service.sessions.chronicle import Chronicle
from scanner_service.sessions.engine import Engine
from scanner_service.sessions.errors import SessionBusy, SessionError
from scanner_service.sessions.judgement import Judgement
from scanner_service.sessions.readiness import warm_up
from scanner_service.sessions.references import NO_NOMINAL, Nominal
from scanner_service.sessions.reopening import take_in
from scanner_service.sessions.replay_source import ReplaySource
from scanner_service.sessions.results import Results
from scanner_service.sessions.scan_clock import ScanClock
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source import Pausable, Source
from scanner_service.sessions.status import Status
from scanner_service.sessions.still_sources import PushSource
from scanner_service.sessions.updates import Changes, PointPage, VerdictBook, changes_since, read_page
from scanner_service.sessions.wires import Wires
from scanner_service.sessions.withdrawals import SCAN_ENDED, WITHDRAWN
from scanner_service.storage.formats.reference_mesh import ReferenceSpec
from scanner_service.storage.record import Record
from scanner_service.storage.rows import EventRow, SessionRow, Stored

_LOG = logging.getLogger(__name__)
REQUIREMENT_CHANGED = "requirement_changed"
ANALYSIS_PERIOD_S = 1.0
"""The map is read about this often during a scan; regions are looked for as often as `Cadence` allows."""
_COMMIT_PATIENCE_S = 10.0


class LiveSession:
    """One session held open. Its methods may be called from any thread."""

    def __init__(
        self,
        row: SessionRow,
        record: Record,
        source: Source,
        clock: Callable[[], float] = time.monotonic,
        nominal: Nominal = NO_NOMINAL,
    ) -> None:
        self.row = row
        self.settings = SessionSettings.from_dict(row.settings)
        self.source = source
        self.engine = Engine(row.session_id, record, self.settings.map_settings(), np.array(row.origin_mm))
        self.verdicts = VerdictBook()
        self._record = record
        self._chronicle = Chronicle(record, row.session_id)
        self._judgement = Judgement(
            self.engine, self.verdicts, self.settings.requirement(), nominal, self._chronicle.event, clock
        )
        self._nominal = nominal
        self._time = ScanClock(clock)
        self._state = row.state
        self._message: str | None = None
        self._latest: deque[tuple[Scanline, float]] = deque(maxlen=8)
        self._over = threading.Condition()
        self._lock = threading.RLock()
        self._asking = threading.Lock()  # one after the other may change what is asked for
        self._held = False
        self._closing = threading.Event()
        self._is_closing = False
        self._wires = Wires(source)
        self._analyst = threading.Thread(target=self._analyse, name=f"analyst-{row.session_id}", daemon=True)

    @property
    def state(self) -> str:
        """One of `status.STATES`."""
        return self._state

    def open(self, on_progress: Callable[[int], None] = lambda lines: None) -> None:
        """Take what the record already holds of the session into the map, then be ready.

        Raises RecordError when the record cannot be read; a damaged line is told in the status and left out.
        """
        warm_up()
        reopened = take_in(self._record, self.engine, on_progress)
        if reopened.regions is not None:
            self._judgement.go_on_from(reopened.regions)
        elif isinstance(self.source, ReplaySource) and self.source.left is not None:
            self._judgement.compare_with(self.source.left)
        if reopened.kept is not None:
            self._chronicle.kept(reopened.kept)
            self._time.go_on_from(float(reopened.kept.get("elapsed_s") or 0.0))
            self._wires = Wires(self.source, earlier_account=reopened.kept.get("device"))
        self._message = reopened.message
        if reopened.ended_since or self._state in ("stopped", "failed", "interrupted"):
            self.engine.close_passes()
        self.engine.start()
        self._analyst.start()

    # -- what a user does ---------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin, or go on, to scan.

        Raises
        ------
        SessionBusy : the session is scanning, or its source was used up.
        PassRefused : the scanner cannot drive this pass at all; the session has failed, and let go of it.
        SourceUnusable, DriverError : the source cannot start; the state is unchanged.
        """
        with self._lock:
            if self._state == "scanning":
                raise SessionBusy("the session is scanning already")
            if self._state == "paused":
                raise SessionBusy("the session is paused: resume it")
            if self._state != "created" and not isinstance(self.source, PushSource):
                raise SessionBusy(f"the session is {self._state}; create another one to scan again")
            before, self._state = self._state, "scanning"  # a short source may end before its start returns
            self._time.start()
            try:
                self.source.start(self)
            except PassRefused as error:
                self.source.stop()
                self._finish(str(error))
                raise
            except BaseException:
                self._time.stop()
                self._state = before
                raise
            self._set_state(self._state)

    def carry_out(self, open_source: Callable[[], Source]) -> None:
        """Scan one more pass of a session that is over, from a source of its own.

        Raises
        ------
        SessionBusy : the session is not stopped.
        SourceUnusable, DriverError : the source cannot be opened or started; the session stays as it was.
        """
        with self._lock:
            if self._state != "stopped":
                raise SessionBusy(f"the session is {self._state}: a further pass can be scanned once it is stopped")
            known = self.source
            source = open_source()
            if self._is_closing:  # meanwhile somebody wanted it closed: nothing is to be switched on any more
                source.stop()
                raise SessionBusy("the session is being closed")
            if (
                source.towards_sensor is None
                or known.towards_sensor is None
                or not np.allclose(source.towards_sensor, known.towards_sensor)
            ):
                source.towards_sensor = None  # the passes look from several sides: each is judged by its own rays
            before = self._wires
            self.source, self._state = source, "scanning"
            self._wires = before.followed_by(source)
            self._time.start()
            try:  # what the pass is judged by is in the record before any line of it
                self.event(CALIBRATED, calibration_of(source))
                source.start(self)
            except BaseException:
                self.event(CALIBRATED, calibration_of(known))
                self._time.stop()
                self.source, self._state = known, "stopped"
                self._wires = before
                source.stop()
                raise
            self._set_state(self._state)

    def push(self, line: Scanline) -> "Future[Stored]":
        """Hand over a scanline of a client; the future has the record's answer once the line is durable.

        Raises
        ------
        SessionBusy : the session does not take pushed lines, or is not started.
        """
        if not isinstance(self.source, PushSource):
            raise SessionBusy("this session reads from a source of its own and takes no pushed scanlines")
        with self._lock:  # a line is before the end of the scan, and judged, or refused
            if self._state != "scanning":
                verb = "resume" if self._state == "paused" else "start"
                raise SessionBusy(f"the session is {self._state}: {verb} it before pushing scanlines")
            reply: Future[Stored] = Future()
            self._latest.append((line, self._time.now_s()))
            self.engine.put(line, reply)
            return reply

    def withdraw_pass(self, key: PassKey) -> int:
        """Take a pass out of the map; the raw lines and the withdrawal itself stay in the record.

        Returns how many points that were; 0, and nothing recorded, when the pass is unknown or withdrawn already.
        """
        named = {"device_id": key[0], "boot_id": key[1], "pass_index": key[2]}
        if not self.engine.ask(lambda engine: engine.live_map.has_pass(key)).result():
            return 0
        # Durable first: a map that forgot what the record still counts would differ after the next start.
        self._record.append_event(self.row.session_id, WITHDRAWN, named, timeout_s=5.0).result(30.0)
        count = self.engine.ask(lambda engine: engine.withdraw_pass(key)).result()
        self._judge()
        if self._state in ("stopped", "failed"):  # what the scan left was of the verdict before
            self._judgement.write_regions_down()
        return count

    def judge_by(self, requirement: Requirement) -> None:
        """Ask for something else from now on: what was scanned already is judged anew before this returns.

        Raises
        ------
        RequirementUnusable : it contradicts itself, or the scanner's noise; what was asked for before stays.
        RecordError : the record does not take it; what was asked for before stays.
        TimeoutError : the record does not answer yet; what was asked for before stays until the session is reopened.
        """
        with self._asking:
            self._ask_for(replace(self.settings, target=requirement), self._nominal)

    def measure_against(self, spec: ReferenceSpec | None, nominal: Nominal) -> None:
        """Measure coverage against another nominal part from now on, None against the surface seen; as `judge_by`."""
        with self._asking:
            self._ask_for(replace(self.settings, reference=spec), nominal)

    def _ask_for(self, settings: SessionSettings, nominal: Nominal) -> None:
        before, now = self.settings.to_dict(), settings.to_dict()
        self._record.change_settings(self.row.session_id, now)  # durable first: it outlasts us
        self.row, self.settings, self._nominal = replace(self.row, settings=now), settings, nominal
        self._judgement.judge_by(settings.requirement(), nominal)
        changed = {name: {"before": before[name], "now": now[name]} for name in now if now[name] != before[name]}
        self.event(REQUIREMENT_CHANGED, changed)
        self._judge()
        if self._state in ("stopped", "failed"):  # what the scan left was of the verdict before
            self._judgement.write_regions_down()

    @property
    def can_pause(self) -> bool:
        """True for a source that can be held and go on."""
        return isinstance(self.source, Pausable)

    def pause(self) -> None:
        """Hold the scan until `resume`: stage and laser of a device stop.

        Raises
        ------
        SessionBusy : the session is not scanning, or its source cannot be held.
        DriverError : the device does not obey; the session scans on.
        """
        with self._lock:
            if self._state != "scanning":
                raise SessionBusy(f"the session is {self._state}: only one that scans can be paused")
            if not isinstance(self.source, Pausable):
                raise SessionBusy("the source of this session cannot be paused: stop it")
            self._held = True  # lines that are still on their way must not look like a scanner that came back
            try:
                self.source.pause()
            except BaseException:
                self._held = False
                raise
            if self._state != "scanning":  # it ended meanwhile
                self._held = False
                return
            self._time.stop()
            self.event("paused", {})
            self._message = "paused; resume it to go on"
            self._set_state("paused")

    def resume(self) -> None:
        """Go on after a pause, or after an interruption that was too long to go on by itself; the laser is switched on.

        Raises
        ------
        SessionBusy : there is nothing to resume.
        DriverError : the device does not do it; the session stays paused.
        """
        with self._lock:
            if self._state != "paused":
                raise SessionBusy(f"the session is {self._state}: only one that is paused can be resumed")
            if not self._held or not isinstance(self.source, Pausable):
                raise SessionBusy("the scanner is gone; the session goes on, or can be resumed, when it is back")
            self.source.resume()
            self._held = False
            self._time.start()
            self.note("resumed", {"by": "request"})

    def stop(self) -> None:
        """End the scan: close the source and the passes, judge what there is; idempotent."""
        if self._state in ("scanning", "paused", "created"):
            self.source.stop()
            self._finish(None)

    def close(self) -> None:
        """Let go of everything; a session that is scanning is stopped first."""
        self._is_closing = True
        with self._lock:  # a pass that is just being started has started, and is stopped, or never does
            pass
        try:
            self.stop()
        finally:
            self._closing.set()
            if self._analyst.is_alive():
                self._analyst.join()
            self._chronicle.close()
            self.engine.close()

    def mark_region(self, region_id: int, status: RegionStatus, why: str) -> None:
        """Say of a region that it is unreachable, or that it is not after all; kept in the record.

        Raises
        ------
        SessionError : no such region is open.
        """
        self._judgement.mark_region(region_id, status, why)

    # -- what a source says (Sink) ------------------------------------------------------------------------------

    def line(self, line: Scanline | StoredLine) -> None:
        """A scanline from the source; when the engine is gone, it is counted there and the source is told to stop."""
        if self._state == "paused" and not self._held:  # lines flow again, whatever was or was not said of the link
            self.note("resumed", {})
        if isinstance(line, Scanline):
            self._latest.append((line, self._time.now_s()))
        try:
            self.engine.put(line)
        except SessionError as error:
            _LOG.warning("a scanline of session %s was not taken: %s", self.row.session_id, error)
            self.source.stop()

    def note(self, kind: str, details: dict[str, Any]) -> None:
        """An event from the source: goes into the record, and may pause or resume the session."""
        self.event(kind, details)
        if kind == "interrupted":
            self._message = f"the scanner is gone ({details.get('reason')}); waiting for it to return"
            self._set_state("paused")
        elif kind == "held":
            self._held = True
            self._time.stop()
            self._message = (
                "the pass was interrupted for too long to go on by itself, and the laser is off: "
                f"resume it to go on at {details.get('from_mm')} mm, or stop it"
            )
            self._set_state("paused")
        elif kind == "resumed" and not self._held:
            self._message = None
            self._set_state("scanning")

    def ended(self, failure: str | None) -> None:
        """The source is used up."""
        if self._state in ("scanning", "paused"):
            self._finish(failure)

    # -- what a reader asks -------------------------------------------------------------------------------------

    def changes_since(self, version: int) -> "Future[Changes]":
        """Which points changed after `version` of the map as it is now; 0 asks for all."""
        return self.engine.ask_between(lambda engine: changes_since(engine.live_map, version))

    def read_page(self, changes: Changes, start: int, count: int) -> "Future[PointPage]":
        """What is said of the changed points from number `start` on, at most `count` of them."""
        return self.engine.ask_between(lambda engine: read_page(engine.live_map, self.verdicts, changes, start, count))

    def latest_lines(self) -> list[tuple[Scanline, float]]:
        """The last few scanlines with the seconds at which they came, the oldest first."""
        return list(self._latest)

    def event(self, kind: str, details: dict[str, Any]) -> None:
        """Put an event into the session's record."""
        self._chronicle.event(kind, details)

    def past_events(self) -> Iterator[EventRow]:
        """The events that the record holds of the session, the oldest first."""
        return self._record.events(self.row.session_id)

    def results(self) -> Results | None:
        """The latest verdict; None before the first."""
        return self._judgement.results()

    def fresh_results(self) -> Results:
        """A verdict on everything that was put in before this call."""
        results = self._judge()
        if results is None:
            raise SessionError(self.engine.failure or "the session is closed")
        return results

    def wait_until_over(self, timeout_s: float | None = None) -> bool:
        """Wait until the session is stopped or failed, and judged if it can be; False when not after `timeout_s`."""
        with self._over:
            return self._over.wait_for(lambda: self._state in ("stopped", "failed"), timeout_s)

    def elapsed_s(self) -> float:
        """Seconds of scanning, over all starts of the session and without its pauses."""
        return self._time.elapsed_s()

    def losses(self) -> dict[str, Any]:
        """The whole ledger: lines, points, each pass, and the sum of what the drivers of all passes counted."""
        ledger = self.engine.ledger.snapshot()  # before the wires' accounts: see there
        wires = self._wires
        return ledger.to_dict(wires.account(), wires.passes())

    def status(self) -> Status:
        """What the session is doing now."""
        ledger = self.engine.ledger
        elapsed = self.elapsed_s()
        results = self._judgement.results()
        durable = {
            device: {"boot_id": mark.boot_id, "line_index": mark.line_index, "lines": mark.line_count}
            for device, mark in self._record.watermark(self.row.session_id).items()
        }
        return Status(
            session_id=self.row.session_id,
            name=self.row.name,
            state=self._state,
            created_utc=self.row.created_utc,
            lines=ledger.stored,
            points=ledger.counted,
            points_per_s=ledger.counted / elapsed if elapsed > 0 else 0.0,
            coverage=results.share if results is not None else float("nan"),
            coverage_kind=results.coverage_kind if results is not None else "observed",
            verdict_age_s=self._judgement.age_s(),
            progress=self.source.progress(),
            losses=self.losses(),
            durable=durable,
            message=(
                self.engine.failure
                or self._chronicle.trouble()
                or self._message
                or (results.reference_refused if results else None)
            ),
            held=self._held,
            holds=results.holds if results is not None else None,
        )

    # -- inside -------------------------------------------------------------------------------------------------

    def _finish(self, failure: str | None) -> None:
        """Close the passes and judge for the last time; the state changes when the verdict is there.

        An engine that was ended by a fault can do neither: then the session has failed, with what was judged before.
        """
        with self._lock:
            if self._state in ("stopped", "failed"):
                return
            self._time.stop()
            try:
                self.engine.ask(lambda engine: engine.close_passes()).result()
                # The account of a scan that is over is whole: the last commits are waited for, while there are any.
                self.engine.ledger.wait_until_decided(0.0 if self._record.is_failing else _COMMIT_PATIENCE_S)
            except SessionError as error:
                failure = failure or str(error)
            self._held = False
            self._judge()
            self._chronicle.event(SCAN_ENDED, self.losses(), patience_s=5.0)
            self._chronicle.ledger(self.losses(), self.elapsed_s())
            self._judgement.write_regions_down()
            if failure is not None or self._state == "paused":
                self._message = failure  # a scan that is over waits for nothing
            self._set_state("failed" if failure is not None else "stopped")
        with self._over:
            self._over.notify_all()

    def _analyse(self) -> None:
        """The analyst's thread: reads every second what changed of the map, judges as often as its share allows."""
        cadence = Cadence()
        seen = -1
        while not self._closing.wait(ANALYSIS_PERIOD_S):
            begun_s, begun_core_s = self._time.now_s(), time.thread_time()
            is_due = cadence.is_due(begun_s)
            try:
                self._chronicle.watch_the_disk(self.engine.ledger, begun_s)
                self._chronicle.ledger(self.losses(), self.elapsed_s())
                if not is_due:
                    self._judgement.read_map()
                elif self._state in ("scanning", "paused") or self.results() is None:
                    results = self._judge(unless=seen)
                    seen = results.snapshot.version if results is not None else seen
            except Exception as error:  # noqa: BLE001 - the thread's loop: the scan goes on, and its user is told
                _LOG.exception("session %s could not be judged", self.row.session_id)
                self._message = f"the scan could not be judged by an internal fault: {error}"
            if is_due:
                core_s = time.thread_time() - begun_core_s
                cadence.ran(begun_s, self._time.now_s(), core_s, lines_wait=self.engine.is_pressed)

    def _judge(self, unless: int | None = None) -> Results | None:
        return self._judgement.renew(self.source, unless)

    def _set_state(self, state: str) -> None:
        self._state = state
        self._chronicle.state(state)
