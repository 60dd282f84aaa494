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

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

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
    stored lines that the device itself gave no distance for, by the reason it told. `late_reads` counts how often bytes
    had waited for more than a tenth of a second because this computer did not come to read them, and `largest_pause_s`
    is the longest time between two readings, each of which waits for bytes for 0.02 s at most. `passes` has the
    accounts of each pass, by boot id and pass index; they add up to `chunks` and `lines`.
    """

    chunks: ChunkTally = field(default_factory=ChunkTally)
    lines: LineTally = field(default_factory=LineTally)
    duplicates: int = 0
    stale: int = 0
    disagreements: int = 0
    damage: dict[str, int] = field(default_factory=dict)
    bytes_skipped: int = 0
    no_return: dict[str, int] = field(default_factory=dict)
    late_reads: int = 0
    largest_pause_s: float = 0.0
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
            a.late_reads + b.late_reads,
            max(a.largest_pause_s, b.largest_pause_s),
            {**a.passes, **{key: a.passes.get(key, PassTally()) + told for key, told in b.passes.items()}},
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the accounts as plain nested dicts of numbers, ready for JSON."""
        return {
            "chunks": _chunks_to_dict(self.chunks),
            "lines": _lines_to_dict(self.lines),
            "duplicates": self.duplicates,
            "stale": self.stale,
            "disagreements": self.disagreements,
            "damage": dict(self.damage),
            "bytes_skipped": self.bytes_skipped,
            "no_return": dict(self.no_return),
            "late_reads": self.late_reads,
            "largest_pause_s": self.largest_pause_s,
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
