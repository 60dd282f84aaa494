"""The one thread that writes the record, in batches that wait for their commit; knows no schema and no line format.

An error from COMMIT does not mean "not committed". So a batch that failed is kept, and before it is tried again the
record is asked for the number of its last batch: if it is this one, it is in, and its answers stand.
"""

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, Generic, NamedTuple, TypeVar

from sqlalchemy import Connection, select
from sqlalchemy.exc import (
    DataError,
    DBAPIError,
    IntegrityError,
    InterfaceError,
    NotSupportedError,
    ProgrammingError,
)

from scanner_service.storage.answer import Answer, give
from scanner_service.storage.batch import Batch, batch_number, set_batch_number
from scanner_service.storage.errors import RecordBusy, RecordClosed, RecordError, RecordUnusable, WriteRefused
from scanner_service.storage.place import Place, StorageFault
from scanner_service.storage.rows import Limits, Stored, Watermark, WriterState
from scanner_service.storage.tables import sessions
from scanner_service.storage.tail import Tail

T = TypeVar("T")
_log = logging.getLogger(__name__)
_REOPEN_AFTER = 4  # failed attempts with one connection
_DATABASE_REFUSES = (IntegrityError, DataError, ProgrammingError, NotSupportedError, InterfaceError)
_VALUE_FAULTS = (*_DATABASE_REFUSES, OverflowError, TypeError, ValueError)


class Job(NamedTuple, Generic[T]):
    """Something to be done in a transaction, and the promise of its answer."""

    run: Callable[[Batch], T]
    size_bytes: int
    is_line: bool
    answer: Answer[T]


class Writer:
    """Owns the connection that writes; jobs are done in the order in which they were submitted."""

    def __init__(self, place: Place, limits: Limits) -> None:
        self._place = place
        self._engine = place.writer_engine()
        self._limits = limits
        self._connection: Connection | None = self._engine.connect()  # the thread's alone from here on
        self._batch_number = batch_number(self._connection)
        gone = select(sessions.c.session_id).where(sessions.c.deleted_utc != "")
        self._deleting = deque(self._connection.execute(gone).scalars())
        self._connection.rollback()
        self._tails: dict[str, Tail] = {}
        self._since_checkpoint_bytes = limits.checkpoint_bytes  # what a killed service left is copied first of all
        self._change = threading.Condition()
        self._door = threading.Condition()  # of all answers
        self._queue: deque[Job[Any]] = deque()
        self._in_hand: list[Job[Any]] = []
        self._state = WriterState()
        self._counts = dict.fromkeys(("stored", "duplicates", "conflicts", "refused", "batches", "retries"), 0)
        self._waiting_bytes = 0
        self._waiting_lines = 0
        self._watermarks: dict[str, dict[str, Watermark]] = {}
        self._give_up_s: float | None = None  # monotonic; set by close
        self._thread = threading.Thread(target=self._run, name="record-writer", daemon=True)
        self._thread.start()

    # --- any thread ---------------------------------------------------------------------------------------------

    def submit(self, run: Callable[[Batch], T], size_bytes: int, timeout_s: float, is_line: bool = False) -> Answer[T]:
        """Queue a job; waits up to `timeout_s` for room in the spool.

        Raises
        ------
        RecordBusy : the spool is still full; the job was not taken.
        RecordClosed : the record is closed or closing; the job was not taken.
        """
        answer: Answer[T] = Answer(self._door)
        with self._change:
            if timeout_s > 0 and not self._has_room(size_bytes):
                self._change.wait_for(lambda: self._give_up_s is not None or self._has_room(size_bytes), timeout_s)
            if self._give_up_s is not None or not self._has_room(size_bytes):
                self._counts["refused"] += is_line
                if self._give_up_s is not None:
                    raise RecordClosed("the record is closed; nothing more is stored")
                raise RecordBusy(
                    f"the record is busy ({self._waiting_lines} lines, {self._waiting_bytes} bytes wait"
                    f"{'; ' + self._state.reason if self._state.reason else ''}); offer it again later"
                )
            self._queue.append(Job(run, size_bytes, is_line, answer))
            self._waiting_bytes += size_bytes
            self._waiting_lines += is_line
            self._change.notify_all()
        return answer

    def state(self) -> WriterState:
        """How the writer is now."""
        with self._change:
            return replace(
                self._state,
                waiting_lines=self._waiting_lines,
                waiting_bytes=self._waiting_bytes,
                stored=self._counts["stored"],
                duplicates=self._counts["duplicates"],
                conflicts=self._counts["conflicts"],
                refused=self._counts["refused"],
                batches=self._counts["batches"],
                retries=self._counts["retries"],
            )

    @property
    def is_failing(self) -> bool:
        """True while the record cannot be written; costs nothing, and is asked for every line."""
        return self._state.state == "failing"

    def watermarks(self, session_id: str) -> Mapping[str, Watermark] | None:
        """The watermarks of a session written to since the record was opened; None of any other."""
        with self._change:
            return self._watermarks.get(session_id)

    def close(self, timeout_s: float) -> int:
        """Take nothing more, write what waits for at most about `timeout_s`; the number of lines given up."""
        with self._change:
            if self._give_up_s is None:
                self._give_up_s = time.monotonic() + timeout_s
            self._change.notify_all()
        self._thread.join(timeout_s + self._limits.longest_retry_s)
        with self._change:
            return self._waiting_lines

    @property
    def is_alive(self) -> bool:
        """True until the thread has ended."""
        return self._thread.is_alive()

    def _has_room(self, size_bytes: int) -> bool:
        return not self._waiting_bytes or self._waiting_bytes + size_bytes <= self._limits.spool_bytes

    # --- the writer's thread ------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while True:
                jobs = self._take()
                if jobs:
                    self._store(jobs)
                elif self._deleting and self._give_up_s is None:
                    self._delete_slice()
                elif self._give_up_s is not None:
                    break
                if self._is_time_to_checkpoint():
                    self._checkpoint()
            self._checkpoint(everything=True)
        except Exception:  # noqa: BLE001 - the thread's loop: whatever it is, nobody may be left waiting
            _log.exception("the writer of the record stopped")
            with self._change:
                self._state = replace(self._state, state="failing", reason="the writer stopped; see the log")
                self._give_up_s = time.monotonic()
        finally:
            self._stop()

    def _is_time_to_checkpoint(self) -> bool:
        """Copying is put off while jobs wait, up to four times as much."""
        due, most = self._limits.checkpoint_bytes, 4 * self._limits.checkpoint_bytes
        return self._since_checkpoint_bytes >= (most if self._queue else due)

    def _take(self) -> list[Job[Any]]:
        """What is queued, up to the bounds of a batch; empty when closing, or when there is time for deleting."""
        limits = self._limits
        with self._change:
            while not self._queue and self._give_up_s is None and not self._deleting:
                self._change.wait()
            if limits.linger_s > 0 and self._queue:
                self._change.wait_for(self._batch_is_full, limits.linger_s)
            jobs: list[Job[Any]] = []
            size_bytes = 0
            while self._queue and len(jobs) < limits.batch_lines:
                size_bytes += self._queue[0].size_bytes
                if jobs and size_bytes > limits.batch_bytes:
                    break
                jobs.append(self._queue.popleft())
            self._in_hand = jobs
            return jobs

    def _batch_is_full(self) -> bool:
        full = len(self._queue) >= self._limits.batch_lines or self._waiting_bytes >= self._limits.batch_bytes
        return full or self._give_up_s is not None

    def _store(self, jobs: list[Job[Any]]) -> None:
        """Make a batch durable, however long it takes, then answer; only `close` gives up."""
        number = self._batch_number + 1
        delay_s = self._limits.first_retry_s
        attempts = 0
        done: tuple[Batch, list[Any]] | None = None
        while True:
            try:
                if done is None or not self._is_in(number):
                    done = None
                    with self._transaction() as connection:
                        batch, answers = self._perform(connection, jobs)
                        set_batch_number(connection, number)
                        done = batch, answers  # from here on the batch may be in, whatever COMMIT says
                self._place.check()
                break
            except (*_VALUE_FAULTS, DBAPIError, StorageFault) as error:
                if _blames_a_value(error):
                    if len(jobs) > 1:  # one of them is to blame: alone, each gets its own answer
                        for job in jobs:
                            self._store([job])
                    else:
                        self._answer(jobs, [WriteRefused(f"the database refused it: {_reason(error)}")])
                    return
                attempts += 1
                if not self._wait_to_retry(error, delay_s, attempts):
                    reason = f"not confirmed as stored when the record was closed: {_reason(error)}"
                    self._answer(jobs, [RecordClosed(reason)] * len(jobs), given_up=True)
                    return
                delay_s = min(2 * delay_s, self._limits.longest_retry_s)
        batch, answers = done
        self._batch_number = number
        self._tails |= batch.tails
        for session_id in batch.deleted:
            self._tails.pop(session_id, None)
            self._deleting.append(session_id)
        self._since_checkpoint_bytes += sum(job.size_bytes for job in jobs)
        with self._change:
            self._state = replace(self._state, state="ok", reason="")
            self._counts["batches"] += 1
            self._watermarks |= {session_id: tail.watermarks() for session_id, tail in batch.tails.items()}
            for session_id in batch.deleted:
                self._watermarks.pop(session_id, None)
        self._answer(jobs, answers)

    def _perform(self, connection: Connection, jobs: list[Job[Any]]) -> tuple[Batch, list[Any]]:
        batch = Batch(connection, self._tails)
        answers: list[Any] = []
        for job in jobs:
            try:
                answers.append(job.run(batch))
            except RecordError as error:
                answers.append(error)
        batch.finish()
        return batch, answers

    def _answer(self, jobs: list[Job[Any]], answers: list[Any], given_up: bool = False) -> None:
        names = {"stored": "stored", "duplicate": "duplicates", "conflict": "conflicts"}
        with self._change:
            for job, answer in zip(jobs, answers, strict=True):
                self._waiting_bytes -= job.size_bytes
                self._waiting_lines -= job.is_line and not given_up
                self._counts["refused"] += job.is_line and isinstance(answer, Exception) and not given_up
                if isinstance(answer, Stored):
                    self._counts[names[answer.outcome]] += 1
            self._change.notify_all()
        give([job.answer for job in jobs], answers, self._door)

    def _wait_to_retry(self, error: Exception, delay_s: float, attempts: int) -> bool:
        """Say what is wrong and wait; False when it is time to give up."""
        if attempts == 1:
            _log.error("the record cannot be written, trying again: %s", _reason(error))
        if self._connection is not None and (
            attempts % _REOPEN_AFTER == 0 or self._connection.in_transaction() or self._connection.invalidated
        ):
            self._disconnect()  # a disk, or a server, that went away and came back needs a new connection
        with self._change:
            self._state = replace(self._state, state="failing", reason=_reason(error))
            self._counts["retries"] += 1
            if self._give_up_s is None:
                self._change.wait_for(lambda: self._give_up_s is not None, delay_s)
                return True
            left_s = self._give_up_s - time.monotonic()
        time.sleep(max(0.0, min(delay_s, left_s)))
        return left_s > 0

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[Connection]:
        if self._connection is None:
            try:
                self._connection = self._engine.connect()
                self._check_nobody_else_wrote(self._connection)
            except RecordUnusable as error:
                raise StorageFault(str(error)) from error
        try:
            with self._connection.begin():
                yield self._connection
        except BaseException:
            self._leave_transaction()
            raise

    def _leave_transaction(self) -> None:
        """After a COMMIT that failed SQLAlchemy believes the transaction over, and the database may still be in it."""
        if self._connection is None or self._connection.invalidated:
            return
        try:
            self._connection.connection.rollback()
        except Exception:  # noqa: BLE001 - a connection that cannot even do this is thrown away
            self._disconnect()

    def _check_nobody_else_wrote(self, connection: Connection) -> None:
        """While we were without a connection, and without its lock, another service may have taken the record over."""
        with connection.begin():
            found = batch_number(connection)
        if found not in (self._batch_number, self._batch_number + 1):
            self._disconnect()
            raise StorageFault("another service has written the record meanwhile; stop one of them and start again")

    def _is_in(self, number: int) -> bool:
        with self._transaction() as connection:
            return batch_number(connection) == number

    def _delete_slice(self) -> None:
        session_id = self._deleting[0]
        job: Job[bool] = Job(lambda batch: batch.delete_slice(session_id), 0, False, Answer(self._door))
        self._store([job])
        self._since_checkpoint_bytes += self._limits.batch_bytes
        if job.answer.exception() is None and job.answer.result():
            self._deleting.popleft()

    def _checkpoint(self, everything: bool = False) -> None:
        """Have the log copied where the database leaves that to us."""
        self._since_checkpoint_bytes = 0
        if self._connection is None:
            return
        problem = self._place.copy_log(self._connection, everything=everything, longest_bytes=self._limits.wal_bytes)
        if problem:
            _log.error("the record's log could not be copied into its file: %s", problem)
        with self._change:
            self._state = replace(self._state, checkpoint_problem=problem)

    def _disconnect(self) -> None:
        if self._connection is not None:
            with contextlib.suppress(Exception):  # it is thrown away, whatever it says
                self._connection.close()
            self._connection = None

    def _stop(self) -> None:
        """Answer everybody who still waits, and let go of the file."""
        with self._change:
            if self._give_up_s is None:
                self._give_up_s = time.monotonic()
            left = [job for job in (*self._in_hand, *self._queue) if not job.answer.done()]
            self._queue.clear()
        self._answer(left, [RecordClosed("the record closed before this was stored")] * len(left), given_up=True)
        self._disconnect()
        with self._change:
            if self._state.state == "ok":
                self._state = replace(self._state, state="closed")


def _blames_a_value(error: Exception) -> bool:
    """True when the database refused what was to be written; a server that went away refuses nothing."""
    return isinstance(error, _VALUE_FAULTS) and not (isinstance(error, DBAPIError) and error.connection_invalidated)


def _reason(error: Exception) -> str:
    text = str(error.orig if isinstance(error, DBAPIError) else error).strip()
    return text.splitlines()[0] if text else type(error).__name__
