"""Chunks become profiles, and every one of them is accounted for; knows no port, no clock and no commands."""

from collections.abc import Callable

import numpy as np

from drivers.boot_ledger import BootLedger, Kind
from drivers.protocols.framing import Damage
from drivers.protocols.native_messages import (
    NM_PER_MM,
    NO_RETURN,
    TENTH_UM_PER_MM,
    UNKNOWN_NM,
    Chunk,
    Hello,
    PositionKind,
    Status,
)
from drivers.scanline import DeviceInfo, Profile
from drivers.tally import Tally


class OpenLine:
    """One line while its chunks arrive; every chunk repeats the line's header, so any of them will do first."""

    def __init__(self, chunk: Chunk, line_index: int, arrival_s: float) -> None:
        self.line_index = line_index
        self.header = chunk
        self.arrival_s = arrival_s
        self.n_chunks = 0
        self._points = np.full((chunk.points_in_line, 2), NO_RETURN, dtype=np.int32)
        self._missing_flags = bytearray(b"\1") * chunk.points_in_line  # the array below, as bytes
        self._missing = np.frombuffer(self._missing_flags, dtype=np.bool_)
        self._n_missing = chunk.points_in_line

    @property
    def is_whole(self) -> bool:
        """True when every point's chunk has arrived."""
        return self._n_missing == 0

    def has_room_for(self, chunk: Chunk) -> bool:
        """True unless a chunk of this line contradicts those before."""
        return (
            chunk.pass_index == self.header.pass_index
            and chunk.points_in_line == len(self._missing)
            and 0 not in self._missing_flags[_place(chunk)]
        )

    def add(self, chunk: Chunk) -> bool:
        """Take a chunk of this line; False, and nothing taken, when there is no room for it."""
        if not self.has_room_for(chunk):
            return False
        place = _place(chunk)
        self._points[place] = chunk.points
        self._missing[place] = False
        self._n_missing -= len(chunk.points)
        self.n_chunks += chunk.n_chunks
        return True

    def profile(self, info: DeviceInfo, encoder_mm_per_count: float) -> Profile:
        """Return what has arrived, in millimetres; points without a return, and missing ones, are NaN."""
        header = self.header
        xz_mm = self._points / TENTH_UM_PER_MM
        no_return = self._points == NO_RETURN
        xz_mm[no_return[:, 0] | no_return[:, 1]] = np.nan
        return Profile(
            device_id=info.device_id,
            boot_id=header.boot_id,
            pass_index=header.pass_index,
            line_index=self.line_index,
            device_time_s=header.device_time_us / 1e6,
            arrival_s=self.arrival_s,
            x_mm=xz_mm[:, 0].copy(),
            z_mm=xz_mm[:, 1].copy(),
            missing=self._missing,
            laser_mm=np.array(header.laser) / TENTH_UM_PER_MM,
            position_mm=position_mm(header, encoder_mm_per_count),
            line_spacing_mm=_length_mm(header.line_spacing_nm),
            step_mm=_length_mm(header.step_nm),
        )


def _place(chunk: Chunk) -> slice:
    return slice(chunk.first_point, chunk.first_point + len(chunk.points))


def position_mm(chunk: Chunk, encoder_mm_per_count: float) -> float:
    """Return the stage position of a chunk's line in millimetres; NaN when it has none."""
    if chunk.position_kind is PositionKind.STAGE_NM:
        return _length_mm(chunk.position)
    if chunk.position_kind is PositionKind.ENCODER_COUNT and encoder_mm_per_count != 0:
        return chunk.position * encoder_mm_per_count
    return float("nan")


def _length_mm(length_nm: int) -> float:
    return float("nan") if length_nm == UNKNOWN_NM else length_nm / NM_PER_MM


class ProfileStream:
    """The chunks of one device, over its boots, as profiles and as a tally.

    `hello` is the first one: the account begins at its totals. `deliver` takes each closed profile, whole or partial,
    and returns False when it could not: the line is then counted as `host_overflow`. A line is closed when it is
    complete, when a later line begins, when the totals say that nothing of it can follow, or by `close_line`.
    """

    def __init__(self, hello: Hello, deliver: Callable[[Profile], bool]) -> None:
        status = hello.status
        self.info = hello.info
        self.encoder_mm_per_count = hello.encoder_mm_per_count
        self._deliver = deliver
        self._open: OpenLine | None = None
        self._earlier_boots = Tally()
        self._earlier_ids: set[int] = set()
        self._boot_id = status.boot_id
        self._ledger = BootLedger(
            status.next_sequence, status.next_line, status.dropped_chunks, status.dropped_lines, status.boot_id
        )

    @property
    def boot_id(self) -> int:
        """The boot that is now accounted for."""
        return self._boot_id

    @property
    def has_open_line(self) -> bool:
        """True while chunks of a line are awaited."""
        return self._open is not None

    def tally(self) -> Tally:
        """Return the accounts of all boots so far."""
        return self._earlier_boots + self._ledger.tally()

    def introduce(self, hello: Hello) -> None:
        """Take a further hello of the same device: its identity, then its totals."""
        self.info = hello.info
        self.encoder_mm_per_count = hello.encoder_mm_per_count
        self.totals(hello.status)

    def totals(self, status: Status) -> None:
        """Take the device's totals."""
        if not self._is_current(status.boot_id):
            return
        if self._open is not None and (status.next_line - self._open.header.line_index) % 2**32 in range(1, 2**31):
            self.close_line()
        self._ledger.totals(
            status.next_sequence,
            status.next_line,
            status.dropped_chunks,
            status.dropped_lines,
            status.pass_index,
            pass_is_over=not status.streaming,
        )

    def chunk(self, chunk: Chunk, arrival_s: float) -> bool:
        """Take what was read at `arrival_s`; True when something of it was new and not of an earlier boot."""
        if not self._is_current(chunk.boot_id):
            for _ in range(chunk.n_chunks):
                self._ledger.count_stale()
            return False
        if chunk.n_chunks > 1 and not (self._ledger.is_next(chunk.sequence) and self._fits(chunk)):
            were_new = [self.chunk(single, arrival_s) for single in chunk.apart()]
            return any(were_new)
        arrival = self._ledger.chunk(
            chunk.sequence,
            chunk.line_index,
            chunk.dropped_chunks,
            chunk.dropped_lines,
            chunk.pass_index,
            chunk.n_chunks,
        )
        if arrival.kind is not Kind.NEW:
            return False
        if arrival.opens_line:
            self.close_line()
            self._open = OpenLine(chunk, arrival.line, arrival_s)
        if self._open is None or self._open.line_index != arrival.line:
            self._ledger.not_kept("late", chunk.n_chunks)
        elif not self._open.add(chunk):
            self._ledger.not_kept("conflict")
        elif self._open.is_whole:
            self.close_line()
        return True

    def damage(self, damage: Damage) -> None:
        """Take a damaged piece of the stream."""
        self._ledger.damage(damage.reason.value, damage.n_bytes)

    def link_lost(self) -> None:
        """The link is down: what was collected of a line is handed on."""
        self.close_line()
        self._ledger.link_lost()

    def close_line(self) -> None:
        """Hand on the open line, if there is one, as it is."""
        line, self._open = self._open, None
        if line is None:
            return
        if self._deliver(line.profile(self.info, self.encoder_mm_per_count)):
            self._ledger.line_closed(whole=line.is_whole)
        else:
            self._ledger.line_not_kept("host_overflow", line.n_chunks)

    def is_new_boot(self, boot_id: int) -> bool:
        """True when the device must have rebooted to say this boot id."""
        return boot_id != self._boot_id and boot_id not in self._earlier_ids

    def begin_boot(self, boot_id: int) -> None:
        """Begin a new account, from zero: the device has rebooted."""
        self.close_line()
        self._earlier_ids.add(self._boot_id)
        self._earlier_boots += self._ledger.tally()
        self._boot_id = boot_id
        self._ledger = BootLedger(boot_id=boot_id)

    def _fits(self, run: Chunk) -> bool:
        """True when chunks of one line share one fate: all are kept, or none."""
        line = self._open
        return line is None or line.header.line_index != run.line_index or line.has_room_for(run)

    def _is_current(self, boot_id: int) -> bool:
        """Begin a new account when the device has rebooted; False for an earlier boot."""
        if self.is_new_boot(boot_id):
            self.begin_boot(boot_id)
        return boot_id == self._boot_id
