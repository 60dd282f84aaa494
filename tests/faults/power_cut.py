"""What a disk holds after the power was cut: what was synced, and of the rest any part, torn and out of order.

Knows a log of writes and syncs, no SQLite and no record. The model: a write that was synced is there. One that was not
is there, or not, or in part: sector by sector in any order, the last one perhaps ending in the middle or in rubbish,
never beyond the bytes that were written (as SQLite assumes of a disk, "powersafe overwrite"). A failed sync leaves each
write before it either durable or lost for good, also when a later sync succeeds. A name that was made or removed is
there, or not, until its folder was synced.
"""

import random
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from tests.faults.sqlite_disk import Entry

SECTOR_BYTES = 512


@dataclass
class _File:
    """One file as an inode: what is surely on the disk, and what was done since its last sync."""

    durable: bytearray = field(default_factory=bytearray)
    pending: list[Entry] = field(default_factory=list)
    is_new: bool = True

    def sync(self) -> None:
        for entry in self.pending:
            _apply(self.durable, entry)
        self.pending = []

    def sync_failed(self, rng: random.Random) -> None:
        for entry in self.pending:
            if rng.random() < 0.5:
                _apply(self.durable, entry)
        self.pending = []

    def after_cut(self, rng: random.Random) -> bytes:
        content = bytearray(self.durable)
        left = list(self.pending)
        if rng.random() < 0.5:
            left = [sector for entry in left for sector in _sectors(entry)]
        if rng.random() < 0.7:
            rng.shuffle(left)
        chance = rng.choice((0.0, 0.2, 0.5, 0.9, 1.0))
        for entry in left:
            if rng.random() < chance:
                _apply(content, _torn(entry, rng))
        return bytes(content)


class DiskImage:
    """The disk's content at one place of a log; `step` goes on, `after_cut` says what a cut here may leave."""

    def __init__(self, files: Mapping[str, bytes], rng: random.Random) -> None:
        self._rng = rng
        self._names: dict[str, list[_File | None]] = {
            path: [_File(bytearray(content), is_new=False)] for path, content in files.items()
        }

    def step(self, entries: Iterable[Entry]) -> None:
        """Do what the log says."""
        for entry in entries:
            if entry.kind == "mark":
                continue
            names = self._names.setdefault(entry.path, [None])
            file = names[-1]
            if entry.kind == "delete":
                names.append(None)
                if entry.offset:
                    self._names[entry.path] = [None]
                continue
            if entry.kind == "create" or file is None:
                file = _File()
                names.append(file)
            match entry.kind:
                case "write" | "truncate":
                    file.pending.append(entry)
                case "sync":
                    file.sync()
                    if file.is_new:  # SQLite syncs the folder with the first sync of a journal it made
                        file.is_new = False
                        self._names[entry.path] = [file]
                case "sync_failed":
                    file.sync_failed(self._rng)

    def after_cut(self) -> dict[str, bytes]:
        """The files that may be found after a cut now."""
        found = {}
        for path, history in self._names.items():
            file = self._rng.choice(history)
            if file is not None:
                found[path] = file.after_cut(self._rng)
        return found


def _apply(content: bytearray, entry: Entry) -> None:
    if entry.kind == "truncate":
        del content[entry.offset :]
        content.extend(bytes(entry.offset - len(content)))
        return
    content.extend(bytes(max(0, entry.offset + len(entry.data) - len(content))))
    content[entry.offset : entry.offset + len(entry.data)] = entry.data


def _sectors(entry: Entry) -> list[Entry]:
    """A write as writes of one sector each, so that they can be reordered and lost one by one."""
    if entry.kind != "write":
        return [entry]
    first = entry.offset - entry.offset % SECTOR_BYTES
    places = [max(entry.offset, place) for place in range(first, entry.offset + len(entry.data), SECTOR_BYTES)]
    ends = [*places[1:], entry.offset + len(entry.data)]
    return [
        Entry("write", entry.path, start, entry.data[start - entry.offset : end - entry.offset])
        for start, end in zip(places, ends, strict=True)
    ]


def _torn(entry: Entry, rng: random.Random) -> Entry:
    """Often the write itself; else its beginning, perhaps followed by a sector's worth of rubbish."""
    if entry.kind != "write" or rng.random() < 0.6:
        return entry
    kept = rng.randrange(len(entry.data) + 1)
    if rng.random() < 0.5:
        kept -= kept % SECTOR_BYTES
    data = entry.data[:kept]
    if rng.random() < 0.3:
        data += rng.randbytes(min(SECTOR_BYTES, len(entry.data) - kept))
    return Entry("write", entry.path, entry.offset, data)
