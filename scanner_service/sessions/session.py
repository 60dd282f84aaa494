"""A live scan session: one source, one engine, one analyst, and the state that a user sees; knows no HTTP."""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivers.scanline import Scanline
from drivers.tally import PassTally
from scanner_service.analysis.errors import AnalysisError
from scanner_service.analysis.intake import StoredLine
from scanner_service.analysis.passes import PassKey, pass_key
from scanner_service.rescan.followed import RegionBook
from scanner_service.rescan.reference import ReferenceSurface
from scanner_service.rescan.region import RegionStatus
from scanner_service.sessions.engine import Engine, is_partial
from scanner_service.sessions.errors import SessionBusy, SessionError
from scanner_service.sessions.ledger import Ledger
from scanner_service.sessions.mirror import Mirror, difference_since
from scanner_service.sessions.readiness import warm_up
from scanner_service.sessions.results import Results, judge
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.sources import OnAWire, Pausable, PushSource, Source, SpentSource
from scanner_service.sessions.updates import Changes, PointPage, VerdictBook, changes_since, read_page
from scanner_service.sessions.withdrawals import SCAN_ENDED, WITHDRAWN, ends_of_passes, withdrawn_passes
from scanner_service.storage.errors import RecordError
from scanner_service.storage.record import Record
from scanner_service.storage.rows import SessionRow, Stored, WriterState

_LOG = logging.getLogger(__name__)
ANALYSIS_PERIOD_S = 1.0
"""Regions are looked for about this often during a scan, and less often when one search takes long."""

_STATE_PATIENCE_S = 2.0
REGIONS_CHANGED = "regions_changed"
REGIONS_FOLLOWED = "regions_followed"
"""Events: what became of regions at one verdict; and, when a scan is over, what a later opening goes on with."""

STATES = ("created", "scanning", "paused", "interrupted", "stopped", "failed")


@dataclass(frozen=True, slots=True)
class Status:
    """What a session is doing, for people: counts, rates, losses and, when something is amiss, one sentence.

    `lines` and `points`: stored in the record, and counted in the map. `held`: a pause that lasts until somebody
    resumes it.
    """

    session_id: str
    name: str
    state: str
    created_utc: str
    lines: int
    points: int
    points_per_s: float
    coverage: float
    progress: float | None
    losses: dict[str, Any]
    durable: dict[str, dict[str, int]]
    message: str | None
    held: bool


class LiveSession:
    """One session held open. Its methods may be called from any thread."""

    def __init__(
        self,
        row: SessionRow,
        record: Record,
        source: Source,
        clock: Callable[[], float] = time.monotonic,
        reference: ReferenceSurface | None = None,
    ) -> None:
        self.row = row
        self.settings = SessionSettings.from_dict(row.settings)
        self.source = source
        self.engine = Engine(row.session_id, record, self.settings.map_settings(), np.array(row.origin_mm))
        self.verdicts = VerdictBook()
        self._record = record
        self._clock = clock
        self._state = row.state
        self._message: str | None = None
        self._latest: deque[tuple[Scanline, float]] = deque(maxlen=8)
        self._results: Results | None = None
        self._reference = reference
        self._regions = RegionBook()
        self._following = threading.Lock()
        self._mirror = Mirror()
        self._mirroring = threading.Lock()
        self._results_changed = threading.Condition()
        self._lock = threading.RLock()
        self._begun_s: float | None = None
        self._ended_s: float | None = None
        self._earlier_s = 0.0  # of scanning before this session was reopened, or started again
        self._held = False
        self._kept: Mapping[str, Any] | None = None  # the account of losses that was written last
        self._disk = _DiskWatch()
        self._owed: deque[tuple[str, dict[str, Any]]] = deque(maxlen=1000)  # events that a failing disk did not take
        self._closing = threading.Event()
        self._is_closing = False
        self._earlier_wire: Mapping[PassKey, PassTally] = {}
        self._analyst = threading.Thread(target=self._analyse, name=f"analyst-{row.session_id}", daemon=True)

    @property
    def state(self) -> str:
        """One of STATES."""
        return self._state

    def open(self, on_progress: Callable[[int], None] = lambda lines: None) -> None:
        """Take what the record already holds of the session into the map, then be ready.

        Raises RecordError when the record cannot be read; a damaged line is told in the status and left out.
        """
        warm_up()
        damaged: list[str] = []
        events = list(self._record.events(self.row.session_id))
        ends = ends_of_passes(events)
        partial: Counter[PassKey] = Counter()
        for number, line in self._record.lines(
            self.row.session_id, on_damage=lambda found: damaged.append(found.reason)
        ):
            while ends and ends[0] <= number:
                self.engine.close_passes()
                ends.pop(0)
            try:
                self.engine.restore(line)
            except (AnalysisError, ValueError) as error:
                damaged.append(f"line {number}: {error}")
            partial[pass_key(line)] += is_partial(line)
            on_progress(number)
        for event in events:
            if event.kind == REGIONS_FOLLOWED:
                self._regions = RegionBook.from_dict(event.details)
        for key in withdrawn_passes(events):
            self.engine.withdraw_pass(key)
        kept = self._record.ledger(self.row.session_id)
        self.engine.ledger.reopened(kept, self._record.lines_of_passes(self.row.session_id), partial)
        if kept is not None:
            self._kept, self._earlier_s = kept, float(kept.get("elapsed_s") or 0.0)
            if isinstance(self.source, SpentSource):
                self.source.remember(kept.get("device"))
        if damaged:
            self._message = f"{len(damaged)} stored lines are left out; the first: {damaged[0]}"
        if ends or self._state in ("stopped", "failed", "interrupted"):
            self.engine.close_passes()
        self.engine.start()
        self._analyst.start()

    # -- what a user does ---------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin, or go on, to scan.

        Raises
        ------
        SessionBusy : the session is scanning, or its source was used up.
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
            self._earlier_s = self.elapsed_s()
            self._begun_s, self._ended_s = self._clock(), None
            try:
                self.source.start(self)
            except BaseException:
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
            self.source, self._state = source, "scanning"
            self._earlier_s = self.elapsed_s()
            self._begun_s, self._ended_s = self._clock(), None
            try:
                source.start(self)
            except BaseException:
                self.source, self._state = known, "stopped"
                source.stop()
                raise
            if isinstance(known, OnAWire):
                self._earlier_wire = _joined(self._earlier_wire, known.pass_tallies())
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
            self._latest.append((line, self._clock()))
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
        return count

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
            self._pass_time()
            self._event("paused", {})
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
            self._begun_s = self._clock()
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
            self.engine.close()

    # -- what a source says (Sink) ------------------------------------------------------------------------------

    def line(self, line: Scanline | StoredLine) -> None:
        """A scanline from the source; when the engine is gone, it is counted there and the source is told to stop."""
        if self._state == "paused" and not self._held:  # lines flow again, whatever was or was not said of the link
            self.note("resumed", {})
        if isinstance(line, Scanline):
            self._latest.append((line, self._clock()))
        try:
            self.engine.put(line)
        except SessionError as error:
            _LOG.warning("a scanline of session %s was not taken: %s", self.row.session_id, error)
            self.source.stop()

    def note(self, kind: str, details: dict[str, Any]) -> None:
        """An event from the source: goes into the record, and may pause or resume the session."""
        self._event(kind, details)
        if kind == "interrupted":
            self._message = f"the scanner is gone ({details.get('reason')}); waiting for it to return"
            self._set_state("paused")
        elif kind == "held":
            self._held = True
            self._pass_time()
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
        self._event(kind, details)

    def results(self) -> Results | None:
        """The latest verdict; None before the first."""
        return self._results

    def fresh_results(self) -> Results:
        """A verdict on everything that was put in before this call."""
        results = self._judge()
        if results is None:
            raise SessionError(self.engine.failure or "the session is closed")
        return results

    def wait_until_over(self, timeout_s: float | None = None) -> bool:
        """Wait until the session is stopped or failed, and judged if it can be; False when not after `timeout_s`."""
        with self._results_changed:
            return self._results_changed.wait_for(lambda: self._state in ("stopped", "failed"), timeout_s)

    def elapsed_s(self) -> float:
        """Seconds of scanning, over all starts of the session and without its pauses."""
        if self._begun_s is None:
            return self._earlier_s
        return self._earlier_s + (self._ended_s if self._ended_s is not None else self._clock()) - self._begun_s

    def losses(self) -> dict[str, Any]:
        """The whole ledger: lines, points, each pass, and what the driver of the latest source counted on the wire."""
        source = self.source
        wire = _joined(self._earlier_wire, source.pass_tallies() if isinstance(source, OnAWire) else {})
        return self.engine.ledger.to_dict(source.tally(), wire)

    def status(self) -> Status:
        """What the session is doing now."""
        ledger = self.engine.ledger
        elapsed = self.elapsed_s()
        results = self._results
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
            progress=self.source.progress(),
            losses=self.losses(),
            durable=durable,
            message=(
                self.engine.failure
                or self._disk.message(self._record.writer_state())
                or self._message
                or (results.reference_refused if results else None)
            ),
            held=self._held,
        )

    # -- inside -------------------------------------------------------------------------------------------------

    def _finish(self, failure: str | None) -> None:
        """Close the passes and judge for the last time; the state changes when the verdict is there.

        An engine that was ended by a fault can do neither: then the session has failed, with what was judged before.
        """
        with self._lock:
            if self._state in ("stopped", "failed"):
                return
            try:
                self.engine.ask(lambda engine: engine.close_passes()).result()
            except SessionError as error:
                failure = failure or str(error)
            if not self._held:
                self._ended_s = self._clock()
            self._held = False
            self._judge()
            self._event(SCAN_ENDED, self.losses(), patience_s=5.0)
            self._keep_ledger()
            with self._following:
                self._event(REGIONS_FOLLOWED, self._regions.to_dict())
            if failure is not None or self._state == "paused":
                self._message = failure  # a scan that is over waits for nothing
            self._set_state("failed" if failure is not None else "stopped")
        with self._results_changed:
            self._results_changed.notify_all()

    def _analyse(self) -> None:
        """The analyst's thread: a verdict about every second while the map changes."""
        period_s = ANALYSIS_PERIOD_S
        seen = -1
        while not self._closing.wait(period_s):
            begun_s = self._clock()
            try:
                self._watch_the_disk()
                self._keep_ledger()
                if self._state in ("scanning", "paused") or self._results is None:
                    results = self._judge(unless=seen)
                    seen = results.snapshot.version if results is not None else seen
            except Exception as error:  # noqa: BLE001 - the thread's loop: the scan goes on, and its user is told
                _LOG.exception("session %s could not be judged", self.row.session_id)
                self._message = f"the scan could not be judged by an internal fault: {error}"
            period_s = max(ANALYSIS_PERIOD_S, 2.0 * (self._clock() - begun_s))

    def _judge(self, unless: int | None = None) -> Results | None:
        """Take a snapshot, judge it, and put the verdict in force; None when the engine is gone."""
        try:
            if unless is not None and self.engine.ask(lambda engine: engine.live_map.read_version()).result() == unless:
                return self._results
            with self._mirroring:
                since = self._mirror.version
                change = self.engine.ask(lambda engine: difference_since(engine.live_map, since)).result()
                snapshot = self._mirror.apply(change)
            source = self.source
            results = judge(
                snapshot, self.settings.requirement(), source.geometry, source.towards_sensor, self._reference
            )
            results = self._follow(results)
            self.engine.ask(
                lambda engine: self.verdicts.replace(results.verdict, snapshot.version, engine.live_map)
            ).result()
        except SessionError:
            return None
        with self._results_changed:
            if self._results is None or results.snapshot.version >= self._results.snapshot.version:
                self._results = results
            self._results_changed.notify_all()
        return results

    def _follow(self, results: Results) -> Results:
        """Give the regions the ids they have had, and keep what has changed of them in the record."""
        with self._following:
            changes = self._regions.follow(results.snapshot, results.regions)
            followed = replace(results, regions=self._regions.current, resolved=self._regions.resolved)
        if changes:
            self._event(REGIONS_CHANGED, {"changes": [change.to_dict() for change in changes]})
        return followed

    def mark_region(self, region_id: int, status: RegionStatus, why: str) -> None:
        """Say of a region that it is unreachable, or that it is not after all; kept in the record.

        Raises
        ------
        SessionError : no such region is open.
        """
        with self._following:
            try:
                changes = self._regions.mark(region_id, status, why)
            except KeyError:
                raise SessionError(f"there is no open region {region_id} in this session") from None
            results = self._results
            if results is not None:
                self._results = replace(results, regions=self._regions.current, resolved=self._regions.resolved)
        if changes:
            self._event(REGIONS_CHANGED, {"changes": [change.to_dict() for change in changes]})

    def _pass_time(self) -> None:
        """The clock of the scan stands still from here on."""
        self._earlier_s, self._begun_s = self.elapsed_s(), None

    def _keep_ledger(self) -> None:
        """Write the account of losses into the record when it has changed: a killed service leaves the last one."""
        account = self.losses()
        if self._kept is not None and {**self._kept, "elapsed_s": 0.0} == {**account, "elapsed_s": 0.0}:
            return
        account["elapsed_s"] = self.elapsed_s()
        try:
            self._record.save_ledger(self.row.session_id, account)
        except RecordError:
            return  # the disk is failing: it is kept when that is over
        self._kept = account

    def _watch_the_disk(self) -> None:
        """Tell in the record, once it can be written again, what it missed, and that it could not be."""
        if self._owed and self._record.writer_state().state == "ok":
            self._event(*self._owed.popleft())
        told = self._disk.look(self._record.writer_state(), self.engine.ledger, self._clock())
        if told is not None:
            self._event("record_resumed", told)

    def _event(self, kind: str, details: dict[str, Any], patience_s: float = 1.0) -> None:
        try:
            self._record.append_event(self.row.session_id, kind, details, timeout_s=patience_s)
        except RecordError:
            _LOG.warning("the event %s of session %s will be recorded later", kind, self.row.session_id)
            self._owed.append((kind, details))

    def _set_state(self, state: str) -> None:
        self._state = state
        try:
            self._record.change_state(self.row.session_id, state).result(_STATE_PATIENCE_S)
        except TimeoutError:  # the disk is failing, the scan goes on meanwhile
            _LOG.warning("the state %s of session %s will be recorded later", state, self.row.session_id)
        except RecordError as error:
            _LOG.warning("the state of session %s could not be recorded: %s", self.row.session_id, error)


class _DiskWatch:
    """What a session tells of a record that cannot be written; owned by its analyst, read by whoever asks."""

    def __init__(self) -> None:
        self._since_s: float | None = None
        self._refused_before = 0

    def look(self, writer: WriterState, ledger: Ledger, now_s: float) -> dict[str, Any] | None:
        """How long the record failed and how many lines it cost, once it is over; else None."""
        refused = ledger.refused["record_busy"]
        if writer.state == "failing":
            if self._since_s is None:
                self._since_s = now_s
            return None
        if self._since_s is None:
            self._refused_before = refused
            return None
        told = {"failed_for_s": round(now_s - self._since_s, 3), "lines_lost": refused - self._refused_before}
        self._since_s, self._refused_before = None, refused
        return told

    @staticmethod
    def message(writer: WriterState) -> str | None:
        """One sentence while the record cannot be written."""
        if writer.state != "failing":
            return None
        return (
            f"the record cannot be written ({writer.reason}): {writer.waiting_lines} lines wait in memory and "
            f"{writer.refused} were lost; free space on its disk, and it goes on by itself"
        )


def _joined(a: Mapping[PassKey, PassTally], b: Mapping[PassKey, PassTally]) -> dict[PassKey, PassTally]:
    """The accounts of both, those of the same pass added."""
    return {**a, **{key: a[key] + told if key in a else told for key, told in b.items()}}
