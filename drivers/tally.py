"""Exact accounts of what was sent, stored and lost, in chunks and in lines; knows numbers only, no wire and no port.

Two laws hold at any time: chunks sent = stored + lost; lines sent = whole + partial + open + lost. *Sent* is everything
the device has numbered as far as the host can know, from the highest number or the latest totals it has read; what the
device dropped itself is numbered too, and lost. Every loss has one reason:

`device_dropped`  dropped by the device, by its own counter
`disconnected`    in a gap during which the link was down
`damaged`         in a gap in which damaged bytes were read
`missing`         in a gap that nothing explains
`late`            read, but after its line was closed
`conflict`        read, but it contradicts its line
`host_overflow`   read, but the host's own queue was full

Both laws hold for each pass by itself too. A loss is booked on the pass that ran when the gap began; after the end of a
pass, on the one that ends the gap. The end of a pass and the acknowledgement of the next one's start carry totals, so
what is lost is booked on the wrong one of two passes only when both of these are lost as well. A latecomer
moves the number it fills to the pass it names.

Counted apart, outside both laws: `duplicates` (a number read twice), `stale` (older than the account, or than the
65,536 numbers in which a latecomer can be told from a duplicate) and `disagreements` (chunks by which the device's drop
counter exceeds the gap it should explain).
"""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from drivers.protocols.unwrap import increase_u32, unwrap_u32

_WINDOW = 65_536
_MAX_GAPS = 1_024
MAX_PASSES = 1_024
OTHER_PASSES = -1
"""The pass under which everything is booked once a boot has told of more passes than can be kept apart."""


@dataclass(frozen=True, slots=True)
class ChunkTally:
    """Chunks: `sent == stored + sum(lost.values())`."""

    sent: int = 0
    stored: int = 0
    lost: dict[str, int] = field(default_factory=dict)

    @property
    def balances(self) -> bool:
        """True when nothing is unaccounted for."""
        return self.sent == self.stored + sum(self.lost.values())


@dataclass(frozen=True, slots=True)
class LineTally:
    """Lines: `sent == whole + partial + open + sum(lost.values())`; `open` is still being collected, 0 or 1."""

    sent: int = 0
    whole: int = 0
    partial: int = 0
    open: int = 0
    lost: dict[str, int] = field(default_factory=dict)

    @property
    def stored(self) -> int:
        """Lines handed on, whole or partial."""
        return self.whole + self.partial

    @property
    def balances(self) -> bool:
        """True when nothing is unaccounted for."""
        return self.sent == self.whole + self.partial + self.open + sum(self.lost.values())


@dataclass(frozen=True, slots=True)
class PassTally:
    """The accounts of one pass."""

    chunks: ChunkTally = field(default_factory=ChunkTally)
    lines: LineTally = field(default_factory=LineTally)

    def __add__(self, other: "PassTally") -> "PassTally":
        return PassTally(_add_chunks(self.chunks, other.chunks), _add_lines(self.lines, other.lines))

    def to_dict(self) -> dict[str, Any]:
        """Return the accounts as plain nested dicts of integers, ready for JSON."""
        return {"chunks": _chunks_to_dict(self.chunks), "lines": _lines_to_dict(self.lines)}


@dataclass(frozen=True, slots=True)
class Tally:
    """A moment's accounts of one scanner; `a + b` joins the accounts of two boots, or of two scanners.

    `damage` counts damaged pieces of the stream by reason, `bytes_skipped` their bytes. `no_return` counts points of
    stored lines that the device itself gave no distance for, by the reason it told. `passes` has the accounts of each
    pass, by boot id and pass index; they add up to `chunks` and `lines`.
    """

    chunks: ChunkTally = field(default_factory=ChunkTally)
    lines: LineTally = field(default_factory=LineTally)
    duplicates: int = 0
    stale: int = 0
    disagreements: int = 0
    damage: dict[str, int] = field(default_factory=dict)
    bytes_skipped: int = 0
    no_return: dict[str, int] = field(default_factory=dict)
    passes: Mapping[tuple[int, int], PassTally] = field(default_factory=dict)

    def __add__(self, other: "Tally") -> "Tally":
        a, b = self, other
        return Tally(
            _add_chunks(a.chunks, b.chunks),
            _add_lines(a.lines, b.lines),
            a.duplicates + b.duplicates,
            a.stale + b.stale,
            a.disagreements + b.disagreements,
            _join(a.damage, b.damage),
            a.bytes_skipped + b.bytes_skipped,
            _join(a.no_return, b.no_return),
            {**a.passes, **{key: a.passes.get(key, PassTally()) + told for key, told in b.passes.items()}},
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the accounts as plain nested dicts of integers, ready for JSON."""
        return {
            "chunks": _chunks_to_dict(self.chunks),
            "lines": _lines_to_dict(self.lines),
            "duplicates": self.duplicates,
            "stale": self.stale,
            "disagreements": self.disagreements,
            "damage": dict(self.damage),
            "bytes_skipped": self.bytes_skipped,
            "no_return": dict(self.no_return),
        }


def _add_chunks(a: ChunkTally, b: ChunkTally) -> ChunkTally:
    return ChunkTally(a.sent + b.sent, a.stored + b.stored, _join(a.lost, b.lost))


def _add_lines(a: LineTally, b: LineTally) -> LineTally:
    return LineTally(a.sent + b.sent, a.whole + b.whole, a.partial + b.partial, a.open + b.open, _join(a.lost, b.lost))


def _chunks_to_dict(chunks: ChunkTally) -> dict[str, Any]:
    return {"sent": chunks.sent, "stored": chunks.stored, "lost": dict(chunks.lost)}


def _lines_to_dict(lines: LineTally) -> dict[str, Any]:
    return {
        "sent": lines.sent,
        "stored": lines.stored,
        "whole": lines.whole,
        "partial": lines.partial,
        "open": lines.open,
        "lost": dict(lines.lost),
    }


def _join(a: dict[str, int], b: dict[str, int]) -> dict[str, int]:
    return {reason: a.get(reason, 0) + b.get(reason, 0) for reason in sorted(a.keys() | b.keys())}


class Kind(Enum):
    """What an arriving chunk is to the account."""

    NEW = "new"
    DUPLICATE = "duplicate"
    STALE = "stale"


@dataclass(frozen=True, slots=True)
class Arrival:
    """An entered chunk: its line index in 64 bits, and whether it is the first of its line."""

    kind: Kind
    line: int
    opens_line: bool


@dataclass(slots=True)
class _Gap:
    """Sequences low to high - 1 that had not arrived when `high` was known; `device` of them the device dropped."""

    low: int
    high: int
    device: int
    cause: str
    account: "_PassAccount"
    filled: set[int] = field(default_factory=set)


@dataclass(slots=True)
class _PassAccount:
    """The account of one pass while it is kept."""

    sent: int = 0
    stored: int = 0
    lost: "Counter[str]" = field(default_factory=Counter)
    lines_sent: int = 0
    whole: int = 0
    partial: int = 0
    open: int = 0
    lost_lines: "Counter[str]" = field(default_factory=Counter)

    def tally(self) -> PassTally:
        return PassTally(
            ChunkTally(self.sent, self.stored, _nonzero(self.lost)),
            LineTally(self.lines_sent, self.whole, self.partial, self.open, _nonzero(self.lost_lines)),
        )


class BootLedger:
    """The account of one boot of one device, pass by pass; counters are u32 on entry and 64 bits inside.

    `sequence` and `line` are the first numbers of the account, `dropped_chunks` and `dropped_lines` the device's drop
    counters at that place; `boot_id` names the boot in the tally.
    """

    def __init__(
        self, sequence: int = 0, line: int = 0, dropped_chunks: int = 0, dropped_lines: int = 0, boot_id: int = 0
    ) -> None:
        self._boot_id = boot_id
        self._next_sequence = sequence
        self._next_line = line
        self._told_below = sequence  # below it a latecomer cannot be told from a duplicate
        self._dropped_chunks = dropped_chunks
        self._dropped_lines = dropped_lines
        self._gaps: deque[_Gap] = deque()
        self._cause = "missing"
        self._passes: dict[int, _PassAccount] = {}
        self._told_pass: int | None = None  # the pass that the device last told of
        self._of_chunk = _PassAccount()  # the account of the last chunk entered
        self._of_open_lines: deque[_PassAccount] = deque()
        self._duplicates = self._stale = self._disagreements = 0
        self._damage: Counter[str] = Counter()
        self._bytes_skipped = 0
        self._no_return: Counter[str] = Counter()

    def is_next(self, sequence: int) -> bool:
        """True when nothing of that number or a later one has been entered."""
        return unwrap_u32(self._next_sequence, sequence) >= self._next_sequence

    def chunk(
        self,
        sequence: int,
        line: int,
        dropped_chunks: int,
        dropped_lines: int,
        pass_index: int = 0,
        n_chunks: int = 1,
    ) -> Arrival:
        """Enter a chunk that was read, as stored; what comes of it otherwise is told by `not_kept`.

        Of a line's chunks whose numbers follow each other `n_chunks` are entered at once; the first `is_next` then.
        """
        number = unwrap_u32(self._next_sequence, sequence)
        line = unwrap_u32(self._next_line, line)
        if number < self._next_sequence:
            return Arrival(self._latecomer(number, pass_index), line, False)
        gap_account = self._account(pass_index if self._told_pass is None else self._told_pass)
        account = self._of_chunk = self._account(pass_index)
        cause = self._advance(number, dropped_chunks, gap_account)
        self._next_sequence = number + n_chunks
        self._told_pass = pass_index
        account.sent += n_chunks
        account.stored += n_chunks
        if line < self._next_line:
            return Arrival(Kind.NEW, line, False)
        self._advance_line(line, dropped_lines, cause, gap_account)
        self._next_line = line + 1
        account.lines_sent += 1
        account.open += 1
        self._of_open_lines.append(account)
        return Arrival(Kind.NEW, line, True)

    def totals(
        self,
        next_sequence: int,
        next_line: int,
        dropped_chunks: int,
        dropped_lines: int,
        pass_index: int | None = None,
        pass_is_over: bool = False,
    ) -> None:
        """Enter the device's word on what it has numbered so far; older word than known is passed over.

        `pass_index` is its latest pass; once that is over, what is numbered further belongs to the next one.
        """
        number = unwrap_u32(self._next_sequence, next_sequence)
        if number < self._next_sequence:
            return
        line = unwrap_u32(self._next_line, next_line)
        told = self._told_pass if self._told_pass is not None else pass_index
        account = self._account(OTHER_PASSES if told is None else told)
        cause = self._advance(number, dropped_chunks, account)
        if line >= self._next_line:
            self._advance_line(line, dropped_lines, cause, account)
        if pass_index is not None:
            self._told_pass = None if pass_is_over else pass_index

    def damage(self, reason: str, n_bytes: int) -> None:
        """Enter a damaged piece of the stream; it explains the gap it lies in, if there is one."""
        self._damage[reason] += 1
        self._bytes_skipped += n_bytes
        if self._cause == "missing":
            self._cause = "damaged"

    def link_lost(self) -> None:
        """Enter that the link is down: the gap until the next chunk is `disconnected`."""
        self._cause = "disconnected"

    def no_return(self, counts: dict[str, int]) -> None:
        """Enter points of a line that the device gave no distance for, by reason."""
        self._no_return.update(counts)

    def not_kept(self, reason: str, n_chunks: int = 1) -> None:
        """Move the chunks entered last from the stored to the lost ones."""
        self._of_chunk.stored -= n_chunks
        self._of_chunk.lost[reason] += n_chunks

    def line_closed(self, *, whole: bool) -> None:
        """Enter that the line opened first was handed on."""
        account = self._of_open_lines.popleft()
        account.open -= 1
        account.whole += whole
        account.partial += not whole

    def line_not_kept(self, reason: str, n_chunks: int) -> None:
        """Enter that the line opened first was closed and then lost, with the `n_chunks` of it that had arrived."""
        account = self._of_open_lines.popleft()
        account.open -= 1
        account.lost_lines[reason] += 1
        account.stored -= n_chunks
        account.lost[reason] += n_chunks

    def count_stale(self) -> None:
        """Enter a chunk that is none of this account's."""
        self._stale += 1

    def tally(self) -> Tally:
        """Return the accounts as they stand."""
        passes = {(self._boot_id, index): account.tally() for index, account in self._passes.items()}
        whole = sum(passes.values(), PassTally())
        return Tally(
            whole.chunks,
            whole.lines,
            self._duplicates,
            self._stale,
            self._disagreements,
            _nonzero(self._damage),
            self._bytes_skipped,
            _nonzero(self._no_return),
            {key: told for key, told in passes.items() if told != PassTally()},
        )

    def _account(self, pass_index: int) -> _PassAccount:
        """The account of a pass; a device that tells of more passes than it can have run does not fill the memory."""
        account = self._passes.get(pass_index)
        if account is not None:  # so for every chunk but a pass' first: an account is not made to be thrown away
            return account
        if len(self._passes) >= MAX_PASSES:
            pass_index = OTHER_PASSES
        return self._passes.setdefault(pass_index, _PassAccount())

    def _advance(self, number: int, dropped_chunks: int, account: _PassAccount) -> str:
        """Account for all sequences below `number`; return the cause of the gap that ends there."""
        dropped = increase_u32(self._dropped_chunks, dropped_chunks)
        self._dropped_chunks = dropped_chunks
        lost = number - self._next_sequence
        device = min(dropped, lost)
        self._disagreements += dropped - device
        cause, self._cause = self._cause, "missing"
        if lost:
            account.sent += lost
            account.lost["device_dropped"] += device
            account.lost[cause] += lost - device
            self._gaps.append(_Gap(self._next_sequence, number, device, cause, account))
            self._next_sequence = number
            self._forget_old_gaps()
        return cause

    def _advance_line(self, line: int, dropped_lines: int, cause: str, account: _PassAccount) -> None:
        lost = line - self._next_line
        device = min(increase_u32(self._dropped_lines, dropped_lines), lost)
        self._dropped_lines = dropped_lines
        account.lines_sent += lost
        account.lost_lines["device_dropped"] += device
        account.lost_lines[cause] += lost - device
        self._next_line = line

    def _forget_old_gaps(self) -> None:
        while self._gaps and (len(self._gaps) > _MAX_GAPS or self._gaps[0].high < self._next_sequence - _WINDOW):
            self._told_below = self._gaps.popleft().high

    def _latecomer(self, number: int, pass_index: int) -> Kind:
        if number < max(self._told_below, self._next_sequence - _WINDOW):
            self._stale += 1
            return Kind.STALE
        gap = next((gap for gap in reversed(self._gaps) if gap.low <= number < gap.high), None)
        if gap is None or number in gap.filled:
            self._duplicates += 1
            return Kind.DUPLICATE
        booked = gap.account
        booked.sent -= 1
        if gap.high - gap.low - len(gap.filled) > gap.device:
            booked.lost[gap.cause] -= 1
        else:  # the device sent what it had counted as dropped
            booked.lost["device_dropped"] -= 1
            gap.device -= 1
            self._disagreements += 1
        gap.filled.add(number)
        account = self._of_chunk = self._account(pass_index)
        account.sent += 1
        account.stored += 1
        return Kind.NEW


def _nonzero(counts: Counter[str]) -> dict[str, int]:
    return {reason: count for reason, count in sorted(counts.items()) if count}
