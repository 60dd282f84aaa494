"""Frames that begin with a mark and tell their length: cutting them out of a stream; knows no protocol's layout.

What looks like a beginning and is none costs nothing: the search goes on at the next byte, or one bad length would
swallow good frames.
"""

from abc import ABC, abstractmethod
from typing import Generic, TypeVar

from drivers.protocols.framing import Damage, DamageReason

Item = TypeVar("Item")


class PrefixedDecoder(ABC, Generic[Item]):
    """Bytes in, items and damage out; keeps at most one frame's bytes.

    At any time: bytes received = `accepted_bytes` + bytes of damage + `pending_bytes`.
    """

    failed_check = DamageReason.BAD_SUM

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._skipped_bytes = 0
        self._has_failed_check = False
        self.accepted_bytes = 0

    @abstractmethod
    def _length(self, buffer: bytearray) -> int | None:
        """Bytes of the frame that begins the buffer, 0 when none can; None while that is not known."""

    @abstractmethod
    def _read(self, whole: bytes) -> Item | None:
        """The frame in these bytes; None when its check fails."""

    def _lone(self, byte: int) -> Item | None:
        """What a single byte between frames says, if anything."""
        return None

    @property
    def pending_bytes(self) -> int:
        """Bytes received of which nothing can be said yet."""
        return len(self._buffer) + self._skipped_bytes

    @property
    def has_begun(self) -> bool:
        """True while a frame may be under way."""
        return bool(self._buffer)

    @property
    def has_failed_check(self) -> bool:
        """True when a frame whose check failed is among the bytes of which nothing has been said yet."""
        return self._has_failed_check

    def reset(self) -> int:
        """Forget what has begun; return how many bytes that were."""
        n_bytes = self.pending_bytes
        self._buffer.clear()
        self._skipped_bytes = 0
        self._has_failed_check = False
        return n_bytes

    def receive(self, data: bytes) -> list[Item | Damage]:
        """Take the next bytes; return what they complete."""
        found: list[Item | Damage] = []
        self._buffer += data
        while self._buffer:
            length = self._length(self._buffer)
            if length is None or len(self._buffer) < length:
                break
            if length == 0:
                item = None if self._skipped_bytes else self._lone(self._buffer[0])
                length = 1
            else:
                item = self._read(bytes(self._buffer[:length]))
                self._has_failed_check |= item is None
            if item is None:
                self._skip()
            else:
                self._accept(length, found)
                found.append(item)
        return found

    def break_off(self) -> list[Item | Damage]:
        """The rest of what has begun will not come: search what is there for what it hides, and keep nothing."""
        found: list[Item | Damage] = []
        while self._buffer:
            self._skip()
            found += self.receive(b"")
        self._accept(0, found)
        return found

    def _skip(self) -> None:
        del self._buffer[:1]
        self._skipped_bytes += 1

    def _accept(self, n_bytes: int, found: list[Item | Damage]) -> None:
        if self._skipped_bytes:
            reason = self.failed_check if self._has_failed_check else DamageReason.DEBRIS
            found.append(Damage(reason, self._skipped_bytes))
            self._skipped_bytes = 0
            self._has_failed_check = False
        del self._buffer[:n_bytes]
        self.accepted_bytes += n_bytes
