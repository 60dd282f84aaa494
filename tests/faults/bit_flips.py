"""Rot: one bit of the record's file, or of its log, is flipped; what comes out then is the truth, or it says so."""

import random
import tempfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from scanner_service.storage.errors import RecordError
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.record import Record
from tests.unit.storage.record_lines import bits, line_of

LINES = 60
EVENTS = 10
TRUTH = [bits(line_of(index)) for index in range(LINES)]


@dataclass
class Account:
    """What was seen: flips, those that were told in some way, harmless ones, silent ones; sound lines read."""

    flips: int = 0
    told: int = 0
    harmless: int = 0
    silent: int = 0
    lines_read: int = 0
    first_fault: str = ""


def make(folder: Path) -> tuple[Path, str]:
    """A closed record with one session, and the session's id."""
    with Record.open(folder / "r") as record:
        session = record.create_session("rot", settings={"a": 1}).session_id
        for index in range(LINES):
            record.append(session, line_of(index))
        for index in range(EVENTS):
            record.append_event(session, "kind", {"i": index})
    return folder / "r", session


def flip_bits(count: int, seed: int, on_progress: Callable[[Account], None] = lambda account: None) -> Account:
    """Flip one bit `count` times, each in a fresh copy."""
    account, rng = Account(), random.Random(seed)
    with tempfile.TemporaryDirectory(prefix="flips-") as folder:
        path, session = make(Path(folder))
        whole = path.read_bytes()
        copy = path.with_name("flipped")
        for _ in range(count):
            place = rng.randrange(len(whole))
            copy.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << rng.randrange(8)]) + whole[place + 1 :])
            account.flips += 1
            look(copy, session, f"byte {place}", account)
            on_progress(account)
    return account


def look(path: Path, session: str, what: str, account: Account) -> None:
    """Read everything of a damaged record; nothing false may come out, and what is gone must be told."""
    try:
        with closing(RecordReader.open(path)) as reader:
            (row,) = reader.list_sessions() or [reader.get_session(session)]
            read = {number: bits(line) for number, line in reader.lines(session, on_damage=lambda _: None)}
            events = [event for event in reader.events(session) if not event.damaged]
            found = reader.verify(session)
    except RecordError:
        account.told += 1
        return
    account.lines_read += len(read)
    false = any(TRUTH[number] != line for number, line in read.items())
    false = false or any(event.details != {"i": event.number} for event in events)
    is_whole = len(read) == LINES and len(events) == EVENTS and (row.session_id, row.damaged) == (session, False)
    if false or not (is_whole or found.damaged or found.problems):
        account.silent += 1
        account.first_fault = account.first_fault or f"a silent loss at {what}"
    elif is_whole and not (found.damaged or found.problems):
        account.harmless += 1
    else:
        account.told += 1
