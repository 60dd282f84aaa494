"""Power cuts: the record's own writer at work on a disk that keeps what was synced; each cut must leave a whole record.

A run does whatever a scan does (lines in bursts, repeated lines, events, states, ledgers, deletions, closing, opening
again) while everything that reaches the disk is logged. Then the power is cut at places of that log, and the record
that each cut leaves is opened by the record itself and read from end to end.
"""

import random
import sqlite3
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scanner_service.storage.answer import Answer
from scanner_service.storage.record import Record
from scanner_service.storage.rows import Limits, Stored
from tests.faults.power_cut import DiskImage
from tests.faults.sqlite_disk import Disk, disk_under_sqlite
from tests.unit.storage.record_lines import bits, line_of

LINES_A_RUN = 50
CUTS_A_RUN = 100
POINTS = 60


@dataclass
class Account:
    """What was seen: cuts made, acknowledged lines looked for in them, lost ones, and records that were corrupt."""

    cuts: int = 0
    looked_for: int = 0
    lost: int = 0
    corrupt: int = 0
    syncs_failed: int = 0
    first_fault: str = ""

    def fault(self, kind: str, text: str) -> None:
        setattr(self, kind, getattr(self, kind) + 1)
        self.first_fault = self.first_fault or text


@dataclass
class _Run:
    """The log of one run, the files it began with, and its session."""

    session: str
    files: dict[str, bytes]
    disk: Disk = field(default_factory=lambda: Disk(is_logging=True))


def cut_power(
    cuts: int,
    seed: int,
    connection_class: type[sqlite3.Connection] = sqlite3.Connection,
    on_progress: Callable[[Account], None] = lambda account: None,
) -> Account:
    """Cut the power `cuts` times in as many runs as that takes; `connection_class` is the writer's, for controls."""
    account, rng = Account(), random.Random(seed)
    while account.cuts < cuts:
        with tempfile.TemporaryDirectory(prefix="power-cuts-") as folder:
            run = _at_work(Path(folder), random.Random(rng.getrandbits(64)), connection_class)
            account.syncs_failed += sum(entry.kind == "sync_failed" for entry in run.disk.log)
            places = sorted(rng.randrange(len(run.disk.log) + 1) for _ in range(min(CUTS_A_RUN, cuts - account.cuts)))
            image, done = DiskImage(run.files, rng), 0
            marks: list[Any] = []
            for number, place in enumerate(places):
                image.step(run.disk.log[done:place])
                marks += [entry.mark for entry in run.disk.log[done:place] if entry.kind == "mark"]
                done = place
                _look(Path(folder) / f"cut-{number}", image.after_cut(), run.session, marks, account)
        on_progress(account)
    return account


def _at_work(folder: Path, rng: random.Random, connection_class: type[sqlite3.Connection]) -> _Run:
    path = folder / "r"
    with Record.open(path) as record:
        session = record.create_session("cut").session_id
    run = _Run(session, {str(path): path.read_bytes()})
    run.disk.fails = lambda call, _: "io_sync" if call == "xSync" and rng.random() < 0.02 else None
    limits = Limits(
        batch_lines=rng.choice((1, 4, 32)),
        checkpoint_bytes=rng.choice((1 << 13, 1 << 15, 1 << 20)),
        first_retry_s=0.0005,
        longest_retry_s=0.002,
    )
    with disk_under_sqlite(run.disk):
        next_index = 0
        while next_index < LINES_A_RUN:
            with Record.open(path, limits=limits, connection_class=connection_class) as record:
                stop = min(LINES_A_RUN, next_index + rng.randrange(5, LINES_A_RUN))
                while next_index < stop:
                    next_index = _do_something(record, run, rng, next_index, stop)
    return run


def _do_something(record: Record, run: _Run, rng: random.Random, index: int, stop: int) -> int:
    disk, session = run.disk, run.session
    futures: list[Answer[Any]] = []
    match rng.randrange(10):
        case 0:
            number = record.append_event(session, "mark", {"index": index}).result().number
            disk.mark(("event", number, index))
        case 1:
            record.set_state(session, f"at {index}")
            disk.mark(("state", f"at {index}"))
        case 2:
            record.save_ledger(session, {"index": index}).result()
            disk.mark(("ledger", index))
        case 3:
            other = record.create_session("other").session_id
            futures = [record.append(other, line_of(number, points=POINTS)) for number in range(3)]
            record.delete_session(other)
            disk.mark(("deleted", other))
        case _:
            first = max(0, index - rng.randrange(3))  # a few again: they must be found, not stored twice
            index = min(stop, index + rng.randrange(1, 8))
            for line in range(first, index):
                future = record.append(session, line_of(line, points=POINTS))
                future.add_done_callback(_marking(disk, line))
                futures.append(future)
    if rng.random() < 0.5:
        for future in futures:
            future.result()
    return index


def _marking(disk: Disk, line_index: int) -> Callable[[Answer[Stored]], None]:
    def acknowledged(future: Answer[Stored]) -> None:
        disk.mark(("line", line_index, future.result().line_number))

    return acknowledged


def _look(folder: Path, files: dict[str, bytes], session: str, marks: list[Any], account: Account) -> None:
    """Open what a cut left, and compare it with what had been acknowledged."""
    folder.mkdir()
    for path, content in files.items():
        (folder / Path(path).name).write_bytes(content)
    account.cuts += 1
    try:
        with Record.open(folder / "r") as record:
            _compare(record, session, marks, account)
            assert record.append(session, line_of(LINES_A_RUN, points=POINTS)).result(30).outcome == "stored"
    except Exception as error:  # noqa: BLE001 - whatever it is, the record could not be used
        account.fault("corrupt", f"cut {account.cuts}: {type(error).__name__}: {error}")


def _compare(record: Record, session: str, marks: list[Any], account: Account) -> None:
    lines = {line.line_index: (number, bits(line)) for number, line in record.lines(session)}
    found = record.verify(session)
    whole = sorted(number for number, _ in lines.values()) == list(range(record.count(session).lines))
    true = all(content == bits(line_of(index, points=POINTS)) for index, (_, content) in lines.items())
    if found.damaged or found.problems or not whole or not true:
        account.fault("corrupt", f"cut {account.cuts}: {found.problems or found.damaged or 'lines torn or doubled'}")
    events = {event.number: event.details for event in record.events(session)}
    row, ledger = record.get_session(session), record.ledger(session)
    last = {mark[0]: mark for mark in marks}
    for mark in marks:
        match mark:
            case ("line", index, number):
                account.looked_for += 1
                if lines.get(index, (None,))[0] != number:
                    account.fault("lost", f"cut {account.cuts}: acknowledged line {index} is lost")
            case ("event", number, index):
                if events.get(number) != {"index": index}:
                    account.fault("lost", f"cut {account.cuts}: event {number} is lost")
            case ("deleted", other):
                if any(row.session_id == other for row in record.list_sessions()):
                    account.fault("lost", f"cut {account.cuts}: the deletion of {other} is lost")
    if "state" in last and (not row.state.startswith("at ") or int(row.state[3:]) < int(last["state"][1][3:])):
        account.fault("lost", f"cut {account.cuts}: the state {last['state'][1]} is lost")
    if "ledger" in last and (ledger is None or ledger["index"] < last["ledger"][1]):
        account.fault("lost", f"cut {account.cuts}: the ledger of line {last['ledger'][1]} is lost")
