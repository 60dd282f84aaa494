"""What a session writes of itself into its record: state, events, the account of its losses; never a scanline.

A record that cannot be written for a while must not stop the scan: what it misses is written once it can be.
"""

import logging
from collections import deque
from collections.abc import Mapping
from typing import Any

from scanner_service.sessions.ledger import Ledger
from scanner_service.storage.errors import RecordError
from scanner_service.storage.record import Record
from scanner_service.storage.rows import WriterState

_LOG = logging.getLogger(__name__)
_STATE_PATIENCE_S = 2.0
_MOST_OWED = 1000

RECORD_RESUMED = "record_resumed"


class Chronicle:
    """The pen of one session; owned by it, and tended by its analyst's thread."""

    def __init__(self, record: Record, session_id: str) -> None:
        self._record = record
        self._session_id = session_id
        self._owed: deque[tuple[str, dict[str, Any]]] = deque(maxlen=_MOST_OWED)  # events that the disk did not take
        self._kept: Mapping[str, Any] | None = None  # the account of losses that was written last
        self._disk = _DiskWatch()

    def event(self, kind: str, details: dict[str, Any], patience_s: float = 1.0) -> None:
        """Write an event down, now or when the record can be written again."""
        try:
            self._record.append_event(self._session_id, kind, details, timeout_s=patience_s)
        except RecordError:
            _LOG.warning("the event %s of session %s will be recorded later", kind, self._session_id)
            self._owed.append((kind, details))

    def state(self, state: str) -> None:
        """Write the state down; waits a little until it is durable."""
        try:
            self._record.change_state(self._session_id, state).result(_STATE_PATIENCE_S)
        except TimeoutError:  # the disk is failing, the scan goes on meanwhile
            _LOG.warning("the state %s of session %s will be recorded later", state, self._session_id)
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
        if self._owed and self._record.writer_state().state == "ok":
            self.event(*self._owed.popleft())
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
