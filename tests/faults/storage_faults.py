"""Storage faults: each call that SQLite makes of the disk fails once, or from then on, in each way it can.

The record's own writer does a small piece of work, call after call. At call n the disk fails; while it fails the record
must stay up and say so; when it is well again everything must go on by itself, and all that was taken be there once.
"""

import random
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scanner_service.storage.answer import Answer
from scanner_service.storage.errors import RecordBusy, RecordError, RecordUnusable
from scanner_service.storage.record import Record
from scanner_service.storage.rows import Limits
from tests.faults.sqlite_disk import FAULTS_OF, Disk, disk_under_sqlite
from tests.unit.storage.record_lines import bits, line_of

LINES = 10
POINTS = 60
LIMITS = Limits(checkpoint_bytes=1 << 13, spool_bytes=3 << 10, first_retry_s=0.0005, longest_retry_s=0.002)
_PATIENCE_S = 30.0
ILL_S = 0.02


@dataclass(frozen=True, slots=True)
class Fault:
    """The `number`-th call of its kind fails in this way: once, or all of its kind until the disk is well again."""

    call: str
    error: str
    number: int
    lasts: bool


@dataclass
class Account:
    """What was seen: faults tried, those that were met, acknowledged lines looked for, lost ones, services that died.

    `counted` lines did not fit the bounded spool while the disk was ill: refused, counted, and offered again later.
    """

    faults: int = 0
    met: int = 0
    looked_for: int = 0
    lost: int = 0
    corrupt: int = 0
    died: int = 0
    counted: int = 0
    slowest_return_s: float = 0.0
    refused_to_open: int = 0
    kinds: "Counter[str]" = field(default_factory=Counter)
    first_fault: str = ""

    def fault(self, kind: str, fault: Fault, text: str) -> None:
        setattr(self, kind, getattr(self, kind) + 1)
        self.first_fault = self.first_fault or f"{fault}: {text}"


def every_fault() -> list[Fault]:
    """Every call of a run without faults, failing in each way it can."""
    disk = Disk()
    with tempfile.TemporaryDirectory(prefix="faults-") as folder, disk_under_sqlite(disk):
        path = Path(folder) / "r"
        _prepare(path)
        disk.calls.clear()
        _work(path, [], lambda: None)
    return [
        Fault(call, error, number, lasts)
        for call, errors in FAULTS_OF.items()
        for error in errors
        for number in range(1, disk.calls[call] + 3)
        for lasts in (False, True)
    ]


def inject(faults: list[Fault], on_progress: Callable[[Account], None] = lambda account: None) -> Account:
    """Try the faults one after another."""
    account = Account()
    with tempfile.TemporaryDirectory(prefix="faults-") as first:
        _prepare(Path(first) / "r")
        for fault in faults:
            with tempfile.TemporaryDirectory(prefix="faults-") as folder:
                shutil.copytree(first, folder, dirs_exist_ok=True)
                _try(Path(folder) / "r", fault, account)
            on_progress(account)
    return account


def sample(count: int, seed: int) -> list[Fault]:
    """Some of all faults, each kind of call and error among them."""
    rng, by_kind = random.Random(seed), {}
    faults = every_fault()
    for fault in rng.sample(faults, len(faults)):
        by_kind.setdefault((fault.call, fault.error, fault.lasts), fault)
    chosen = list(by_kind.values())
    return chosen + rng.sample(faults, max(0, count - len(chosen)))


def _prepare(path: Path) -> None:
    with Record.open(path, limits=LIMITS) as record:
        session = record.create_session("faults").session_id
        record.append(session, line_of(0, points=POINTS)).result()


def _work(path: Path, said: list[tuple[int, Any]], heal: Callable[[], None]) -> int:
    """The piece of work: open, store, change, read, close; what was acknowledged goes to `said`; lines counted."""
    counted = 0
    with Record.open(path, limits=LIMITS) as record:
        session = _patiently(record.list_sessions, record, heal)[0].session_id
        for index in range(1, LINES):
            while True:
                try:
                    future = record.append(session, line_of(index, points=POINTS))
                    break
                except RecordBusy:  # what waits for the disk has reached its bound
                    if record.writer_state().state == "failing":
                        counted += 1
                        heal()
                    time.sleep(0.001)
            future.add_done_callback(_saying(said, index))
            if index % 3 == 0:
                _await(future, record, heal)
            if index == 4:
                _patiently(lambda: record.save_ledger(session, {"index": 4}), record, heal)
            if index == 6:
                _patiently(lambda: record.append_event(session, "mark", {}), record, heal)
                _patiently(lambda: record.lines(session, 0, 2), record, heal)
        _await(future, record, heal)
        if record.writer_state().state != "ok":
            raise AssertionError(f"the writer did not recover: {record.writer_state()}")
    return counted


def _patiently(ask: Callable[[], Any], record: Record, heal: Callable[[], None]) -> list[Any]:
    """Ask for something that may be refused, in a sentence, as long as the disk is ill; then once more."""
    for attempt in range(2000):
        try:
            answer = ask()
            if not isinstance(answer, Answer):
                return list(answer)
            _await(answer, record, heal)
            return []
        except RecordError:
            heal()
            time.sleep(0.001)
            if attempt == 1999:
                raise
    return []


def _await(future: Answer[Any], record: Record, heal: Callable[[], None]) -> None:
    """Wait for an answer; when none comes for a while the record must say that it fails, and the disk is healed."""
    try:
        future.result(ILL_S)
    except TimeoutError:
        record.writer_state()
        heal()
        future.result(_PATIENCE_S)


def _saying(said: list[tuple[int, Any]], index: int) -> Callable[[Answer[Any]], None]:
    return lambda future: said.append((index, future.exception() or future.result()))


def _try(path: Path, fault: Fault, account: Account) -> None:
    calls: Counter[str] = Counter()
    is_ill, healed_s = True, [0.0]

    def fails(call: str, _: str) -> str | None:
        calls[call] += 1
        hits = calls[call] >= fault.number if fault.lasts else calls[call] == fault.number
        return fault.error if is_ill and call == fault.call and hits else None

    def heal() -> None:
        nonlocal is_ill
        if is_ill:
            healed_s[0] = time.monotonic()
        is_ill = False

    said: list[tuple[int, Any]] = []
    account.faults += 1
    account.kinds[f"{fault.call} {fault.error}"] += 1
    with disk_under_sqlite(Disk(fails)):
        try:
            account.counted += _work(path, said, heal)
        except RecordUnusable as error:  # it could not even be opened: one sentence, and nothing was changed
            account.refused_to_open += 1
            if "\n" in str(error):
                account.fault("died", fault, str(error))
        except Exception as error:  # noqa: BLE001 - whatever it is, the record did not survive the fault
            account.fault("died", fault, f"{type(error).__name__}: {error}")
    if healed_s[0]:
        account.slowest_return_s = max(account.slowest_return_s, time.monotonic() - healed_s[0])
    account.met += calls[fault.call] >= fault.number
    _look(path, fault, said, account)


def _look(path: Path, fault: Fault, said: list[tuple[int, Any]], account: Account) -> None:
    try:
        with Record.open(path) as record:
            session = record.list_sessions()[0].session_id
            lines = {line.line_index: (number, bits(line)) for number, line in record.lines(session)}
            found = record.verify(session)
            marks = [event for event in record.events(session) if event.kind == "mark"]
    except RecordError as error:
        account.fault("corrupt", fault, str(error))
        return
    numbers = sorted(number for number, _ in lines.values())
    true = all(content == bits(line_of(index, points=POINTS)) for index, (_, content) in lines.items())
    if found.damaged or found.problems or numbers != list(range(len(numbers))) or not true:
        account.fault("corrupt", fault, f"{found.problems or found.damaged or 'lines torn or doubled'}")
    if len(marks) > 1:
        account.fault("corrupt", fault, "an event is stored twice")
    for index, answer in [(0, None), *said]:
        if isinstance(answer, Exception):
            account.fault("died", fault, f"line {index}: {answer}")
            continue
        account.looked_for += 1
        number = 0 if answer is None else answer.line_number
        if lines.get(index, (None,))[0] != number or (answer is not None and answer.outcome != "stored"):
            account.fault("lost", fault, f"line {index}: {answer}")
