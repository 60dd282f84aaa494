"""The account of one boot of a device, kept number by number as its chunks arrive; knows no wire and no port.

What the words mean, and the two laws that hold at any time, is said in `drivers.tally`.
"""

from collections import Counter, deque
from dataclasses import dataclass, field
from enum import Enum

from drivers.protocols.unwrap import increase_u32, unwrap_u32
from drivers.tally import MAX_PASSES, OTHER_PASSES, ChunkTally, LineTally, PassTally, Tally

_WINDOW = 65_536
_MAX_GAPS = 1_024


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
            passes={key: told for key, told in passes.items() if told != PassTally()},
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
