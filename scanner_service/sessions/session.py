"""A live scan session: one source, one engine, one analyst, and the verbs of its user; knows no HTTP."""

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

import numpy as np

from drivers.errors import PassRefused
from drivers.scanline import Scanline
from scanner_service.analysis.passes import PassKey
from scanner_service.rescan.region import RegionStatus
from scanner_service.sessions.analyst import Analyst
from scanner_service.sessions.awaited import AwaitedVerdict
from scanner_service.sessions.calibration import CALIBRATED, calibration_of
from scanner_service.sessions.chronicle import Chronicle
from scanner_service.sessions.course import Course
from scanner_service.sessions.engine import Engine
from scanner_service.sessions.errors import SessionBusy, SessionError
from scanner_service.sessions.hearing import Hearing
from scanner_service.sessions.judgement import Judgement
from scanner_service.sessions.readiness import warm_up
from scanner_service.sessions.references import NO_NOMINAL, Nominal
from scanner_service.sessions.reopening import take_in
from scanner_service.sessions.replay_source import ReplaySource
from scanner_service.sessions.results import Results
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source import Pausable, Source, look_as_before
from scanner_service.sessions.status import Status, durable_told, first_said
from scanner_service.sessions.still_sources import PushSource
from scanner_service.sessions.terms import Terms
from scanner_service.sessions.updates import Changes, PointPage, VerdictBook, changes_since, read_page
from scanner_service.sessions.wires import Wires
from scanner_service.sessions.withdrawals import SCAN_ENDED, withdraw
from scanner_service.storage.record import Record
from scanner_service.storage.rows import EventRow, SessionRow, Stored

REQUIREMENT_CHANGED = "requirement_changed"


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
        self.terms = Terms(row, record, nominal, self._judge_by)
        self.source = source
        self.engine = Engine(row.session_id, record, self.settings.map_settings(), np.array(row.origin_mm))
        self.verdicts = VerdictBook()
        self._record = record
        self._chronicle = Chronicle(record, row.session_id)
        self._course = Course(row.state, clock, self._chronicle.state)
        self._judgement = Judgement(
            self.engine, self.verdicts, self.settings.requirement(), nominal, self._chronicle.event, clock
        )
        self.hearing = Hearing(self.engine, self._course, self._chronicle.event, self._stop_source, self._finish)
        self.doubted: str | None = None  # what is to be decided of its passes; told by whoever keeps their orders
        self._awaited = AwaitedVerdict(clock)
        self._closing = threading.Event()
        self._is_closing = False
        self._wires = Wires(source)
        self._analyst = Analyst(
            row.session_id,
            self._closing,
            clock,
            self._keep_account,
            self._judgement.read_map,
            self._judge_what_is_new,
            lambda: self.engine.is_pressed,
        )

    @property
    def row(self) -> SessionRow:
        """What the record says of the session."""
        return self.terms.row

    @property
    def settings(self) -> SessionSettings:
        """What the session was told, and what is asked of it now."""
        return self.terms.settings

    @property
    def state(self) -> str:
        """One of `status.STATES`."""
        return self._course.state

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
            self._course.time.go_on_from(float(reopened.kept.get("elapsed_s") or 0.0))
            self._wires = Wires(self.source, earlier_account=reopened.kept.get("device"))
        self._course.message = reopened.message
        if reopened.ended_since or self._course.has_ended or self.state == "interrupted":
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
        try:
            with self._course.turn:
                self._course.check_start(again=isinstance(self.source, PushSource))
                with self._course.setting_out():
                    self._set_out(self.source)
        except PassRefused as error:
            self._end(str(error))
            raise
        self._chronicle.settle()

    def _set_out(self, source: Source) -> None:
        try:
            source.start(self.hearing)
        except PassRefused:  # nothing that is tried again will mend it
            source.stop()
            self._course.begin_to_end()
            raise

    def carry_out(self, open_source: Callable[[], Source]) -> None:
        """Scan one more pass of a session that is over, from a source of its own.

        Raises
        ------
        SessionBusy : the session is not over.
        SourceUnusable, DriverError : the source cannot be opened or started; the session stays as it was.
        """
        with self._course.turn:
            self._course.check(("stopped", "failed"), ": a further pass can be scanned once it is over")
            known = self.source
            source = open_source()
            if self._is_closing:  # meanwhile somebody wanted it closed: nothing is to be switched on any more
                source.stop()
                raise SessionBusy("the session is being closed")
            look_as_before(known, source)
            before = self._wires
            try:  # what the pass is judged by is in the record before any line of it
                with self._course.setting_out():
                    self.source, self._wires = source, before.followed_by(source)
                    self.event(CALIBRATED, calibration_of(source))
                    source.start(self.hearing)
            except BaseException:
                self.event(CALIBRATED, calibration_of(known))
                self.source, self._wires = known, before
                source.stop()
                raise
        self._chronicle.settle()

    def push(self, line: Scanline) -> "Future[Stored]":
        """Hand over a scanline of a client; the future has the record's answer once the line is durable.

        Raises
        ------
        SessionBusy : the session does not take pushed lines, or is not started.
        """
        if not isinstance(self.source, PushSource):
            raise SessionBusy("this session reads from a source of its own and takes no pushed scanlines")
        with self._course.line_handed_over():
            reply: Future[Stored] = Future()
            self.hearing.remember(line)
            self.engine.put(line, reply)
            return reply

    def withdraw_pass(self, key: PassKey) -> int:
        """Take a pass out of the map; the raw lines and the withdrawal itself stay in the record.

        Returns how many points that were; 0, and nothing recorded, when the pass is unknown or withdrawn already.
        """
        count = withdraw(self._record, self.engine, key)
        if count:
            self._judge_anew()
        return count

    def _judge_by(self, settings: SessionSettings, nominal: Nominal, changed: dict[str, Any]) -> None:
        self._judgement.judge_by(settings.requirement(), nominal)
        self.event(REQUIREMENT_CHANGED, changed)
        self._judge_anew()

    def _judge_anew(self) -> None:
        with self._awaited.awaited("asked_anew") as begins:
            self._judgement.renew(self.source, begins=begins)
        if self._course.is_ending or self._course.has_ended:  # what the scan left may be of the verdict before
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
        with self._course.turn:
            self._course.check(("scanning",), ": only one that scans can be paused")
            if not isinstance(self.source, Pausable):
                raise SessionBusy("the source of this session cannot be paused: stop it")
            with self._course.holding("paused; resume it to go on"):
                self.source.pause()
            if self._course.is_held:
                self.event("paused", {})
        self._chronicle.settle()

    def resume(self) -> None:
        """Go on after a pause, or after an interruption that was too long to go on by itself; the laser is switched on.

        Raises
        ------
        SessionBusy : there is nothing to resume.
        DriverError : the device does not do it; the session stays paused.
        """
        with self._course.turn:
            self._course.check(("paused",), ": only one that is paused can be resumed")
            if not self._course.is_held or not isinstance(self.source, Pausable):
                raise SessionBusy("the scanner is gone; the session goes on, or can be resumed, when it is back")
            self.source.resume()
            self.event("resumed", {"by": "request"})
            self._course.release()
        self._chronicle.settle()

    def stop(self) -> None:
        """End the scan: close the source and the passes, judge what there is; idempotent."""
        if self._course.is_under_way or self.state == "created":
            self.source.stop()  # one that is just being started does not wait for its turn to end
            if self._course.begin_to_end():
                self._end(None, stops=True)
            else:
                self._course.wait_for_the_other()

    def close(self) -> None:
        """Let go of everything; a session that is scanning is stopped first."""
        self._is_closing = True
        with self._course.turn:  # a pass that is just being started has started, and is stopped, or never does
            pass
        try:
            self.stop()
        finally:
            self._closing.set()
            self._analyst.join()
            self._chronicle.ledger(self.losses(), self.elapsed_s())  # its last one may be older than that of the end
            self._chronicle.close()
            self.engine.close()

    def mark_region(self, region_id: int, status: RegionStatus, why: str) -> None:
        """Say of a region that it is unreachable, or that it is not after all; kept in the record.

        Raises
        ------
        SessionError : no such region is open.
        """
        self._judgement.mark_region(region_id, status, why)

    # -- what a reader asks -------------------------------------------------------------------------------------

    def changes_since(self, version: int) -> "Future[Changes]":
        """Which points changed after `version` of the map as it is now; 0 asks for all."""
        return self.engine.ask_between(lambda engine: changes_since(engine.live_map, version))

    def read_page(self, changes: Changes, start: int, count: int) -> "Future[PointPage]":
        """What is said of the changed points from number `start` on, at most `count` of them."""
        return self.engine.ask_between(lambda engine: read_page(engine.live_map, self.verdicts, changes, start, count))

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
        results = self._judgement.renew(self.source)
        if results is None:
            raise SessionError(self.engine.failure or "the session is closed")
        return results

    def wait_until_over(self, timeout_s: float | None = None) -> bool:
        """Wait until the session is stopped or failed, and judged if it can be; False when not after `timeout_s`."""
        return self._course.wait_until_ended(timeout_s)

    def elapsed_s(self) -> float:
        """Seconds of scanning, over all starts of the session and without its pauses."""
        return self._course.time.elapsed_s()

    def losses(self) -> dict[str, Any]:
        """The whole ledger: lines, points, each pass, and the sum of what the drivers of all passes counted."""
        ledger, wires = self.engine.ledger.snapshot(), self._wires  # before the wires' accounts: see there
        return ledger.to_dict(wires.account(), wires.passes())

    def status(self) -> Status:
        """What the session is doing now."""
        ledger, elapsed, results = self.engine.ledger, self.elapsed_s(), self.results()
        return Status(
            session_id=self.row.session_id,
            name=self.row.name,
            state=self.state,
            created_utc=self.row.created_utc,
            lines=ledger.stored,
            points=ledger.counted,
            points_per_s=ledger.counted / elapsed if elapsed > 0 else 0.0,
            coverage=results.share if results is not None else float("nan"),
            coverage_kind=results.coverage_kind if results is not None else "observed",
            verdict_age_s=self._judgement.age_s(),
            progress=self.source.progress(),
            losses=self.losses(),
            durable=durable_told(self._record.watermark(self.row.session_id)),
            message=first_said(
                self.engine.failure,
                self._chronicle.trouble(),
                self._analyst.failure,
                self._course.message,
                self.doubted,
                self._course.remark,
                *(results.said if results else ()),
            ),
            held=self._course.is_held,
            holds=results.holds if results is not None else None,
            judging=self._awaited.told(),
        )

    # -- inside -------------------------------------------------------------------------------------------------

    def _finish(self, failure: str | None) -> None:
        """End the scan from the source's own thread, unless another does, which may be waiting for this one."""
        if self._course.begin_to_end():
            self._end(failure)

    def _end(self, failure: str | None, stops: bool = False) -> None:
        """Close the passes and judge for the last time; the state changes when the verdict is there.

        `stops`: the source too, which may have started, or taken the place of another, since it was told to stop.

        An engine that was ended by a fault can do neither: then the session has failed, with what was judged before.
        """
        try:
            if stops:
                self.source.stop()
            with self._awaited.awaited("scan_ended") as begins:
                self._course.wait_for_lines()
                try:
                    self.engine.end_scan()
                except SessionError as error:
                    failure = failure or str(error)
                self._judgement.renew(self.source, begins=begins)
            self._chronicle.event(SCAN_ENDED, self.losses())
            self._chronicle.ledger(self.losses(), self.elapsed_s())
            self._judgement.write_regions_down()
            state = "failed" if failure is not None else "stopped"
            self._chronicle.state(state)
            self._chronicle.settle()
        except BaseException:
            self._course.fail_to_end()
            raise
        self._course.end(state, failure)

    def _stop_source(self) -> None:
        self.source.stop()

    def _keep_account(self) -> None:
        self._chronicle.watch_the_disk(self.engine.ledger, self._course.time.now_s())
        self._chronicle.ledger(self.losses(), self.elapsed_s())

    def _judge_what_is_new(self) -> None:
        if self._course.is_under_way or self.results() is None:
            self._judgement.renew(self.source, only_new=True)
