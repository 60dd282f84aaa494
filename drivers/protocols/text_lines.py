"""Lines of text out of a stream of bytes; whatever cannot be a line is damage, counted; knows no protocol."""

from dataclasses import dataclass

MAX_LINE_BYTES = 512
_ENDS = b"\r\n"


@dataclass(slots=True)
class LineCounts:
    """What became of the bytes: `received == in_lines + damaged + ends + waiting`."""

    received: int = 0
    in_lines: int = 0
    damaged: int = 0
    ends: int = 0
    damaged_lines: int = 0


class TextLines:
    """Cuts at CR and LF; a line with bytes that are no printable ASCII, or one too long, is dropped and counted."""

    def __init__(self, max_bytes: int = MAX_LINE_BYTES) -> None:
        self._max_bytes = max_bytes
        self._open = bytearray()
        self._is_overlong = False
        self.counts = LineCounts()

    @property
    def waiting_bytes(self) -> int:
        """Bytes of a line whose end has not come."""
        return len(self._open)

    def receive(self, data: bytes) -> list[str]:
        """Return the lines that `data` completes, without their ends; empty lines are left out."""
        self.counts.received += len(data)
        lines: list[str] = []
        for byte in data:
            if byte in _ENDS:
                self.counts.ends += 1
                self._close(lines)
            elif self._is_overlong:
                self.counts.damaged += 1
            else:
                self._open.append(byte)
                if len(self._open) > self._max_bytes:
                    self._is_overlong = True
                    self.counts.damaged += len(self._open)
                    self.counts.damaged_lines += 1
                    self._open.clear()
        return lines

    def forget(self) -> None:
        """Give up the open line: the link is gone."""
        self.counts.damaged += len(self._open)
        self._open.clear()
        self._is_overlong = False

    def _close(self, lines: list[str]) -> None:
        raw, self._is_overlong = bytes(self._open), False
        self._open.clear()
        if not raw:
            return
        if all(0x20 <= byte < 0x7F for byte in raw):
            self.counts.in_lines += len(raw)
            lines.append(raw.decode("ascii"))
        else:
            self.counts.damaged += len(raw)
            self.counts.damaged_lines += 1
