"""What Trinamic's TMCL says and is told: nine-byte telegrams with their sum; no manners.

Facts from the TMCM manuals and from what pytrinamic sends. Nothing marks the beginning of a telegram: the sum, the
status and the echo of the command are all there is, so a reader must find its place by silence.
"""

from dataclasses import dataclass
from enum import IntEnum

LENGTH = 9


class Command(IntEnum):
    """Commands that a stage needs."""

    ROR = 1
    ROL = 2
    MST = 3
    MVP = 4
    SAP = 5
    GAP = 6
    RFS = 13


class Status(IntEnum):
    """What became of a request."""

    OK = 100
    LOADED = 101
    WRONG_CHECKSUM = 1
    INVALID_COMMAND = 2
    WRONG_TYPE = 3
    INVALID_VALUE = 4
    LOCKED = 5
    UNAVAILABLE = 6


@dataclass(frozen=True, slots=True)
class Telegram:
    """A request or a reply: in a request bytes 2 and 3 are type and motor, in a reply status and command."""

    address: int
    first: int
    second: int
    third: int
    value: int

    @property
    def data(self) -> bytes:
        """The nine bytes."""
        head = bytes((self.address, self.first, self.second, self.third))
        body = head + self.value.to_bytes(4, "big", signed=True)
        return body + bytes((sum(body) & 0xFF,))


def request(address: int, command: int, kind: int, motor: int, value: int) -> Telegram:
    """Return a request."""
    return Telegram(address, command, kind, motor, value)


def parse(data: bytes) -> Telegram | None:
    """Return the telegram of nine bytes; None when their sum is wrong."""
    if len(data) != LENGTH or sum(data[:-1]) & 0xFF != data[-1]:
        return None
    return Telegram(data[0], data[1], data[2], data[3], int.from_bytes(data[4:8], "big", signed=True))


class Telegrams:
    """Telegrams out of a stream that has no beginnings: what checks is taken, else one byte is dropped.

    An 8-bit sum lets 1 in 256 random telegrams pass; a host also compares address, command and status.
    """

    def __init__(self) -> None:
        self._open = bytearray()
        self.skipped_bytes = 0

    @property
    def waiting_bytes(self) -> int:
        """Bytes that are no telegram yet."""
        return len(self._open)

    def receive(self, data: bytes) -> list[Telegram]:
        """Return the telegrams that `data` completes."""
        self._open += data
        found: list[Telegram] = []
        while len(self._open) >= LENGTH:
            telegram = parse(bytes(self._open[:LENGTH]))
            if telegram is None:
                del self._open[0]
                self.skipped_bytes += 1
            else:
                del self._open[:LENGTH]
                found.append(telegram)
        return found

    def silence(self) -> None:
        """Nothing came for more than nine byte times: whatever waits is the rest of a damaged telegram."""
        self.skipped_bytes += len(self._open)
        self._open.clear()
