"""The engine of one session: the one thread that owns its live map, taking one frozen message after another.

Knows the map, the record and the ledger; knows no device, no file and no client. Whoever wants something of the map
asks the engine, which answers between two scanlines.
"""

import contextlib
import logging
import queue
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TypeVar

from drivers.scanline import Float64Array, Scanline
from scanner_service.analysis.errors import MapFull, TooManyPasses
from scanner_service.analysis.intake import StoredLine, quantise
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.analysis.passes import PassKey, pass_key
from scanner_service.sessions.errors import LineRefused, SessionNotLive
from scanner_service.sessions.ledger import Ledger
from scanner_service.storage.answer import Answer
from scanner_service.storage.errors import RecordBusy, RecordError
from scanner_service.storage.record import Record
from scanner_service.storage.rows import Stored

T = TypeVar("T")
_LOG = logging.getLogger(__name__)
INBOX_LINES = 512
_RECORD_PATIENCE_S = 5.0
_COMMIT_PATIENCE_S = 10.0


@dataclass(frozen=True, slots=True)
class _Line:
    line: Scanline | StoredLine
    reply: "Future[Stored] | None"


@dataclass(frozen=True, slots=True)
class _Ask:
    question: "Callable[[Engine], object]"
    reply: "Future[object]"


class _Look:
    """Wakes an engine that has nothing to do: somebody asks between two scanlines."""


class Engine:
    """Owns the live map; everything goes through `inbox`, in the order in which it was put there.

    Only what is asked by `ask_between` does not wait for its turn: it is answered after the scanline under way.
    """

    def __init__(
        self,
        session_id: str,
        record: Record,
        settings: MapSettings,
        origin_mm: Float64Array,
    ) -> None:
        self.session_id = session_id
        self.ledger = Ledger()
        self.live_map = LiveMap(settings, origin_mm)
        self.failure: str | None = None
        self._record = record
        self._seen: set[tuple[str, int, int]] = set()
        self._open: dict[str, PassKey] = {}
        self._inbox: queue.Queue[_Line | _Ask | _Look | None] = queue.Queue(INBOX_LINES)
        self._between: deque[_Ask] = deque()
        self._ended = threading.Event()  # set before the inbox is emptied for the last time: see `_hand_over`
        self._thread = threading.Thread(target=self._run, name=f"engine-{session_id}", daemon=True)

    @property
    def is_pressed(self) -> bool:
        """True while more scanlines wait than come together now and then."""
        return self._inbox.qsize() > INBOX_LINES // 16

    # -- for other threads --------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to take messages."""
        self._thread.start()

    def close(self) -> None:
        """Take what is in the inbox, then end; idempotent."""
        if self._hand_over(None):
            self._thread.join()

    def put(self, line: Scanline | StoredLine, reply: "Future[Stored] | None" = None) -> None:
        """Hand over a scanline, or one out of a record; waits while the inbox is full, so that the source holds it."""
        if reply is not None:
            reply.set_running_or_notify_cancel()  # what is in the inbox cannot be called back
        key = _pass_of(line)
        self.ledger.arrived(key)
        if not self._hand_over(_Line(line, reply)):
            self.ledger.decided("too_late", key)
            raise SessionNotLive(self.failure or "the session is closed and takes no scanlines")

    def ask(self, question: "Callable[[Engine], T]") -> "Future[T]":
        """Have a question answered on the engine's thread, after everything put before it."""
        reply: Future[T] = Future()
        if not self._hand_over(_Ask(question, reply)):  # type: ignore[arg-type]
            reply.set_exception(SessionNotLive(self.failure or "the session is closed"))
        return reply

    def end_scan(self) -> None:
        """Close every pass, and wait until the account of the scan is whole: for the last commits, while there are any.

        Raises SessionNotLive.
        """
        self.ask(lambda engine: engine.close_passes()).result()
        self.ledger.wait_until_decided(0.0 if self._record.is_failing else _COMMIT_PATIENCE_S)

    def ask_between(self, question: "Callable[[Engine], T]") -> "Future[T]":
        """Have a question answered before the next scanline, whatever waits in the inbox; never waits itself.

        It is for whoever shows the map as it is now: behind a full inbox every answer would be seconds old.
        """
        reply: Future[T] = Future()
        if not self._thread.is_alive() or self._ended.is_set():
            reply.set_exception(SessionNotLive(self.failure or "the session is closed"))
            return reply
        self._between.append(_Ask(question, reply))  # type: ignore[arg-type]
        with contextlib.suppress(queue.Full):  # an engine with a full inbox is awake, and looks before each message
            self._inbox.put_nowait(_Look())
        if self._ended.is_set():
            self._refuse_the_rest()
        return reply

    def _hand_over(self, message: "_Line | _Ask | None") -> bool:
        """Put a message into the inbox, waiting while it is full; False when the engine has ended."""
        while self._thread.is_alive() and not self._ended.is_set():
            try:
                self._inbox.put(message, timeout=0.5)
            except queue.Full:
                continue
            if self._ended.is_set():  # perhaps too late for the engine to see it: nobody may be left waiting
                self._refuse_the_rest()
            return True
        return False

    # -- on the engine's thread ---------------------------------------------------------------------------------

    def restore(self, line: StoredLine) -> None:
        """Take a line that is in the record already; before `start` only."""
        self._close_pass_before(line)
        self._enter(line)

    def withdraw_pass(self, key: PassKey) -> int:
        """Take a pass out of the map; returns how many points that were."""
        points = self.live_map.withdraw_pass(key)
        if points:
            self.ledger.withdrawn(points)
        return points

    def close_passes(self) -> None:
        """Close every pass: what was scanned is settled."""
        self.live_map.close_all_passes()
        self._open.clear()

    def _run(self) -> None:
        while True:
            message = self._inbox.get()
            try:
                for _ in range(len(self._between)):
                    self._answer(self._between.popleft())
                if message is None:
                    break
                if isinstance(message, _Line):
                    self._take(message)
                elif isinstance(message, _Ask):
                    self._answer(message)
            except Exception as error:  # noqa: BLE001 - the thread's loop: told to everybody who asks
                _LOG.exception("the engine of session %s stopped", self.session_id)
                self.failure = f"the session stopped by an internal fault: {error}"
                break
        self._ended.set()
        self._refuse_the_rest()
        self.live_map.close()

    def _answer(self, message: _Ask) -> None:
        if not message.reply.set_running_or_notify_cancel():
            return
        try:
            message.reply.set_result(message.question(self))
        except Exception as error:  # noqa: BLE001 - the asker gets it
            message.reply.set_exception(error)

    def _take(self, message: _Line) -> None:
        """One scanline: quantise, record, map; the commit is not waited for."""
        line = message.line
        if not isinstance(line, StoredLine):
            try:
                line = quantise(line, self.live_map.origin_mm)
            except ValueError as error:
                self._refuse(message, "invalid", str(error))
                return
        key = (line.device_id, line.boot_id, line.line_index)
        if key not in self._seen:
            self._close_pass_before(line)
            try:
                self.live_map.can_take(line)
            except (MapFull, TooManyPasses) as error:
                self._refuse(message, "map_full" if isinstance(error, MapFull) else "too_many_passes", str(error))
                return
        try:
            stored = self._record.append(self.session_id, line, timeout_s=self._patience_s())
        except RecordError as error:
            self._refuse(message, "record_busy" if isinstance(error, RecordBusy) else "record_closed", str(error))
            return
        taken = line
        stored.add_done_callback(lambda done: self._committed(done, taken, message.reply))
        if key not in self._seen:
            self._enter(line)

    def _patience_s(self) -> float:
        """How long a line waits for room: a slow disk is waited for; on one that fails, the rest is counted at once."""
        return 0.0 if self._record.is_failing else _RECORD_PATIENCE_S

    def _close_pass_before(self, line: StoredLine) -> None:
        """The first line of a pass ends the device's pass before it."""
        before = self._open.get(line.device_id)
        if before is not None and before != pass_key(line):
            self.live_map.close_pass(before)
        self._open[line.device_id] = pass_key(line)

    def _enter(self, line: StoredLine) -> None:
        self._seen.add((line.device_id, line.boot_id, line.line_index))
        self.ledger.mapped(line, self.live_map.add(line))

    def _refuse(self, message: _Line, reason: str, text: str) -> None:
        self.ledger.decided(reason, _pass_of(message.line))
        if message.reply is not None:
            message.reply.set_exception(LineRefused(reason, text))

    def _committed(self, done: Answer[Stored], line: StoredLine, reply: "Future[Stored] | None") -> None:
        """On the record's writer: the line is durable, or will never be."""
        error = done.exception()
        outcome = done.result().outcome if error is None else "not_stored"
        self.ledger.decided(outcome, pass_key(line), is_partial(line))
        if reply is not None:
            if error is None:
                reply.set_result(done.result())
            else:
                reply.set_exception(error)

    def _refuse_the_rest(self) -> None:
        """What reached the inbox too late is told so."""
        while True:
            try:
                message = self._between.popleft() if self._between else self._inbox.get_nowait()
            except (IndexError, queue.Empty):  # or another thread was faster, which then refuses what is left
                return
            if isinstance(message, _Line):
                self._refuse(message, "too_late", self.failure or "the session was closed before the line's turn came")
            elif isinstance(message, _Ask) and message.reply.set_running_or_notify_cancel():
                message.reply.set_exception(SessionNotLive(self.failure or "the session is closed"))


def is_partial(line: StoredLine) -> bool:
    """True when a piece of the line never arrived."""
    return bool(line.dropped.get("missing"))


def _pass_of(line: Scanline | StoredLine) -> PassKey:
    return (line.device_id, line.boot_id, line.pass_index)
