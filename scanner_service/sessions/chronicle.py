"""What a session writes of itself into its record: state, events, the account of its losses; never a scanline.

A record that cannot be written for a while must not stop the scan: what it misses is written once it can be. Only
`settle` and `close` ever wait for a disk.
"""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any

from scanner_service.sessions.ledger import Ledger
from scanner_service.storage.answer import Answer
from scanner_service.storage.errors import NotStorable, RecordBusy, RecordError
from scanner_service.storage.record import Record
from scanner_service.storage.rows import SessionRow, WriterState

_LOG = logging.getLogger(__name__)
_STATE_PATIENCE_S = 2.0
_MOST_OWED = 1000
_LAST_PATIENCE_S = 2.0

RECORD_RESUMED = "record_resumed"
EVENTS_LOST = "events_lost"
"""Stands where events are missing, and tells how many by reason."""


class Chronicle:
    """The pen of one session; owned by it, and tended by its analyst's thread."""

    def __init__(self, record: Record, session_id: str) -> None:
        self._record = record
        self._session_id = session_id
        self._owed: deque[tuple[str, dict[str, Any]]] = deque()  # events that the disk did not take yet
        self._lost: Counter[str] = Counter()  # events that stood before the first that is owed
        self._state_due: str | None = None  # the state that the disk did not take yet
        self._state_written: Answer[SessionRow] | None = None
        self._pen = threading.Lock()  # whoever holds it writes: events stand in the order in which they came
        self._kept: Mapping[str, Any] | None = None  # the account of losses that was written last
        self._disk = _DiskWatch()

    def event(self, kind: str, details: dict[str, Any]) -> None:
        """Write an event down behind those that are owed, now or when the record can be written again; never waits."""
        with self._pen:
            self._owed.append((kind, details))
            if self._write_owed(0.0):
                return
            _LOG.warning("the event %s of session %s will be recorded later", kind, self._session_id)
            if len(self._owed) > _MOST_OWED:
                gone, _ = self._owed.popleft()
                self._lost["record_busy"] += 1
                _LOG.warning("the event %s of session %s is lost: too many wait for the disk", gone, self._session_id)

    def state(self, state: str) -> None:
        """Write the state down, now or when the record can be written again; never waits."""
        with self._pen:
            self._state_due = state
            self._write_state()

    def settle(self) -> None:
        """Wait a little until the state that was written last is durable."""
        with self._pen:
            written = self._state_written
        if written is None:
            return
        try:
            written.result(_STATE_PATIENCE_S)
        except TimeoutError:  # the disk is failing, the scan goes on meanwhile
            _LOG.warning("the state of session %s will be recorded later", self._session_id)
        except RecordError as error:
            _LOG.warning("the state of session %s could not be recorded: %s", self._session_id, error)

    def ledger(self, account: Mapping[str, Any], elapsed_s: float) -> None:
        """Write the account of losses when it has changed: a service that is killed leaves the last one."""
        if self._kept is not None and {**self._kept, "elapsed_s": 0.0} == {**account, "elapsed_s": 0.0}:
            return
        kept = {**account, "elapsed_s": elapsed_s}
        try:
            self._record.save_ledger(self._session_id, kept)
        except RecordError:
            return  # the disk is failing: it is kept when that is over
        self._kept = kept

    def kept(self, account: Mapping[str, Any]) -> None:
        """This account is in the record already."""
        self._kept = account

    def watch_the_disk(self, ledger: Ledger, now_s: float) -> None:
        """Tell the record, once it can be written again, what it missed, and that it could not be."""
        if self._record.writer_state().state == "ok":
            with self._pen:
                self._write_owed(0.0)
                self._write_state()
        told = self._disk.look(self._record.writer_state(), ledger, now_s)
        if told is not None:
            self.event(RECORD_RESUMED, told)

    def trouble(self) -> str | None:
        """One sentence while the record cannot be written."""
        writer = self._record.writer_state()
        if writer.state != "failing":
            return None
        return (
            f"the record cannot be written ({writer.reason}): {writer.waiting_lines} lines wait in memory and "
            f"{writer.refused} were lost; free space on its disk, and it goes on by itself"
        )

    def close(self) -> None:
        """Write what is still owed; what the record does not take now is lost, and said in the log."""
        with self._pen:
            if not self._write_owed(_LAST_PATIENCE_S):
                number = len(self._owed) + self._lost.total()
                _LOG.error("%d events of session %s are lost: the record took none", number, self._session_id)
            self._write_state()

    def _write_state(self) -> None:
        if self._state_due is None:
            return
        try:
            self._state_written = self._record.change_state(self._session_id, self._state_due)
        except RecordBusy:
            _LOG.warning("the state %s of session %s will be recorded later", self._state_due, self._session_id)
            return
        except RecordError as error:  # now and for ever
            _LOG.warning("the state of session %s could not be recorded: %s", self._session_id, error)
        self._state_due = None

    def _write_owed(self, patience_s: float) -> bool:
        """Write what is owed, in order, until the record takes no more; True when all is written."""
        until_s = time.monotonic() + patience_s
        while self._lost or self._owed:
            kind, details = (EVENTS_LOST, dict(self._lost)) if self._lost else self._owed[0]
            try:
                left_s = max(0.0, until_s - time.monotonic())
                self._record.append_event(self._session_id, kind, details, timeout_s=left_s)
            except NotStorable as error:  # now and for ever: those behind it must not wait for it
                _LOG.warning("the event %s of session %s cannot be recorded: %s", kind, self._session_id, error)
                self._owed.popleft()
                self._lost["not_storable"] += 1
                continue
            except RecordError:
                return False
            if self._lost:
                self._lost.clear()
            else:
                self._owed.popleft()
        return True


class _DiskWatch:
    """Since when a record could not be written, and what that cost."""

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
