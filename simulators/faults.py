"""What a bad cable does to a stream of bytes, and exactly how much of it was done; knows no protocol and no clock."""

from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True, slots=True)
class Faults:
    """How bad the wire is. The default is a good one.

    `bit_error_rate` and `byte_loss_rate` are chances of each bit and each byte. The wire carries *pieces*: what it is
    given at once or, with `piece_bytes` (shortest, longest), cut anew at random lengths, so that nothing can rely on
    chunks. `duplicate_rate`, `delay_rate` and `garbage_rate` are chances of each piece: to come twice, to come behind
    its follower, and to have 1 to `garbage_bytes` random bytes in front.
    """

    bit_error_rate: float = 0.0
    byte_loss_rate: float = 0.0
    duplicate_rate: float = 0.0
    delay_rate: float = 0.0
    garbage_rate: float = 0.0
    garbage_bytes: int = 64
    piece_bytes: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name.endswith("_rate") and not 0.0 <= value <= 1.0:
                raise ValueError(f"{item.name} is a chance between 0 and 1, not {value}")
        if self.garbage_bytes < 1:
            raise ValueError(f"garbage_bytes must be 1 or more, not {self.garbage_bytes}")
        if self.piece_bytes is not None and not 1 <= self.piece_bytes[0] <= self.piece_bytes[1]:
            raise ValueError(f"piece_bytes must be (shortest, longest) with 1 <= shortest, not {self.piece_bytes}")


@dataclass(slots=True)
class FaultCounts:
    """What the wire did. `bytes_in + duplicated_bytes + garbage_bytes == bytes_out + lost_bytes + held_bytes`."""

    bytes_in: int = 0
    bytes_out: int = 0
    flipped_bits: int = 0
    lost_bytes: int = 0
    duplicated_bytes: int = 0
    garbage_bytes: int = 0
    held_bytes: int = 0
    pieces: int = 0
    duplicated_pieces: int = 0
    delayed_pieces: int = 0
    garbage_bursts: int = 0


class FaultyWire:
    """Carries bytes with faults drawn from `rng`; the same bytes in the same portions meet the same faults."""

    def __init__(self, faults: Faults, rng: np.random.Generator) -> None:
        self._faults = faults
        self._rng = rng
        self._held = b""
        self.counts = FaultCounts()

    def carry(self, data: bytes) -> list[bytes]:
        """The pieces that arrive for `data`, in the order of their arrival."""
        arrived: list[bytes] = []
        for piece in self._cut(data):
            arrived += self._carry_piece(piece)
        self.counts.bytes_in += len(data)
        self.counts.bytes_out += sum(map(len, arrived))
        return arrived

    def release(self) -> list[bytes]:
        """The delayed piece, when no follower comes to overtake it."""
        arrived, self._held = [self._held] if self._held else [], b""
        self.counts.bytes_out += self.counts.held_bytes
        self.counts.held_bytes = 0
        return arrived

    def _cut(self, data: bytes) -> list[bytes]:
        if self._faults.piece_bytes is None:
            return [data] if data else []
        shortest, longest = self._faults.piece_bytes
        pieces, start = [], 0
        while start < len(data):
            end = start + int(self._rng.integers(shortest, longest, endpoint=True))
            pieces.append(data[start:end])
            start = end
        return pieces

    def _carry_piece(self, piece: bytes) -> list[bytes]:
        counts, faults = self.counts, self._faults
        counts.pieces += 1
        garbage, twice, late = self._rng.random(3) < (faults.garbage_rate, faults.duplicate_rate, faults.delay_rate)
        piece = self._flip_bits(self._lose_bytes(piece))
        arrived = []
        if garbage:
            burst = self._rng.bytes(int(self._rng.integers(1, faults.garbage_bytes, endpoint=True)))
            counts.garbage_bursts += 1
            counts.garbage_bytes += len(burst)
            arrived.append(burst)
        if piece and late and not self._held:
            counts.delayed_pieces += 1
            counts.held_bytes = len(piece)
            self._held = piece
            return arrived
        if piece:
            arrived.append(piece)
        if piece and twice:
            counts.duplicated_pieces += 1
            counts.duplicated_bytes += len(piece)
            arrived.append(piece)
        if self._held:
            arrived.append(self._held)
            self._held, counts.held_bytes = b"", 0
        return arrived

    def _lose_bytes(self, piece: bytes) -> bytes:
        if self._faults.byte_loss_rate == 0.0:
            return piece
        kept = self._rng.random(len(piece)) >= self._faults.byte_loss_rate
        self.counts.lost_bytes += int((~kept).sum())
        return np.frombuffer(piece, dtype=np.uint8)[kept].tobytes()

    def _flip_bits(self, piece: bytes) -> bytes:
        flips = int(self._rng.binomial(8 * len(piece), self._faults.bit_error_rate))
        if not flips:
            return piece
        bits = np.unpackbits(np.frombuffer(piece, dtype=np.uint8))
        bits[self._rng.choice(len(bits), size=flips, replace=False)] ^= 1
        self.counts.flipped_bits += flips
        return np.packbits(bits).tobytes()


def misread(data: bytes, sent_baud: int, read_baud: int, rng: np.random.Generator) -> bytes:
    """What a receiver at the wrong rate makes of `data`: noise, as many bytes as its own rate has time for."""
    if sent_baud == read_baud:
        return data
    return rng.bytes(max(1, len(data) * read_baud // sent_baud)) if data else b""
