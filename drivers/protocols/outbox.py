"""Bytes on their way to a device, message by message, so that a stop can overtake everything not yet begun; no port."""

from collections import deque


class Outbox:
    """Messages waiting to be written; the first may be written in part."""

    def __init__(self) -> None:
        self._waiting: deque[bytes] = deque()
        self._written = 0  # bytes of the first message that have left

    def __len__(self) -> int:
        return sum(map(len, self._waiting)) - self._written

    def put(self, message: bytes) -> None:
        """Queue a message behind all others."""
        self._waiting.append(message)

    def overtake(self, message: bytes, *, inside_messages: bool = False) -> list[bytes]:
        """Put a message first and throw away those not begun; return what was thrown away.

        A message that is half written is finished first, or the device would read one line made of two; with
        `inside_messages` (a real-time byte that devices pick out of any place) it goes even before that rest.
        """
        rest = self._waiting[0][self._written :] if self._written else b""
        dropped = list(self._waiting)[bool(rest) :]
        self._waiting.clear()
        self._written = 0
        self._waiting.append(message + rest if inside_messages else rest + message)
        return dropped

    def peek(self) -> bytes:
        """Return what may be written now, all of it in order."""
        joined = b"".join(self._waiting)
        return joined[self._written :]

    def wrote(self, n_bytes: int) -> None:
        """Note that so many bytes of `peek` have left."""
        while n_bytes > 0 and self._waiting:
            left = len(self._waiting[0]) - self._written
            if n_bytes < left:
                self._written += n_bytes
                return
            n_bytes -= left
            self._waiting.popleft()
            self._written = 0

    def clear(self) -> None:
        """Forget everything: the link is gone."""
        self._waiting.clear()
        self._written = 0
