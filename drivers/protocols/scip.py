"""SCIP 2.0, the serial protocol of Hokuyo's lidars, both halves of the wire: characters, sums and replies.

It decides nothing: `scip_host.py` has the manners. Facts: Hokuyo C-42-03320B. All is ASCII; a reply is the echo of its
request, a status line, data lines and an empty line. Each line ends with a check character: six bits of the sum.
"""

import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.protocols.framing import Damage, DamageReason
from drivers.scanline import BoolArray

IntArray = npt.NDArray[np.int64]

BLOCK_CHARS = 64
MAX_REPLY_BYTES = 32_768
"""The longest reply is a scan of 1,440 steps with three echoes of distance and intensity: 28,800 characters."""
CLOCK_SPAN = 1 << 24
CLOCK_TICK_S = 1e-3
SCANNING = "99"
"""Status of a reply that carries a scan of a running measurement."""
STREAMS = {"MD": 3, "MS": 2, "ME": 6}
"""Characters of one step; ME is a distance and an intensity of three each."""
SINGLES = {"GD": 3, "GS": 2, "GE": 6}
_FIRST, _LAST = 0x30, 0x6F
_STREAM_ECHO = re.compile(r"(M[DSE]|N[DE])(\d{4})(\d{4})(\d{2})(\d)(\d{2})")


def check_character(data: bytes) -> int:
    """Return the check character of a line: its bytes summed, six bits kept, 30h added."""
    return (sum(data) & 0x3F) + _FIRST


def encode_value(value: int, width: int) -> bytes:
    """Return `value` in `width` characters of six bits, the most significant first; raises ValueError beyond them."""
    if not 0 <= value < 1 << 6 * width:
        raise ValueError(f"{value} does not fit {width} characters of six bits")
    return bytes((value >> 6 * at & 0x3F) + _FIRST for at in range(width - 1, -1, -1))


def decode_values(characters: bytes, width: int) -> IntArray:
    """Return the values (n,) in n * width characters; raises ValueError for a stray character or a rest."""
    if len(characters) % width:
        raise ValueError(f"{len(characters)} characters are no whole number of values of {width}")
    digits = np.frombuffer(characters, dtype=np.uint8).astype(np.int64).reshape(-1, width) - _FIRST
    if digits.size and (digits.min() < 0 or digits.max() > _LAST - _FIRST):
        raise ValueError("a character is none of the 64")
    return np.asarray(digits @ (1 << 6 * np.arange(width - 1, -1, -1, dtype=np.int64)))


def checked(data: bytes) -> bytes:
    """Return a line with its check character and end."""
    return data + bytes([check_character(data)]) + b"\n"


def reply(echo: str, status: str, lines: bytes = b"") -> bytes:
    """Return a whole reply; `lines` come with their sums and ends."""
    return echo.encode("ascii") + b"\n" + checked(status.encode("ascii")) + lines + b"\n"


def info_lines(fields: dict[str, str]) -> bytes:
    """Return the lines of VV, PP and II; the semicolon before the check character is not summed."""
    pieces = (f"{key}:{value}".encode("ascii") for key, value in fields.items())
    return b"".join(piece + b";" + bytes([check_character(piece)]) + b"\n" for piece in pieces)


def data_lines(timestamp: int, characters: bytes) -> bytes:
    """Return the lines of a scan: its time, then its characters in blocks of 64."""
    blocks = (characters[at : at + BLOCK_CHARS] for at in range(0, len(characters), BLOCK_CHARS))
    return checked(encode_value(timestamp % CLOCK_SPAN, 4)) + b"".join(map(checked, blocks))


@dataclass(frozen=True, slots=True)
class Reply:
    """A reply with an intact status line. `lines` still have their check characters: what they are depends."""

    echo: str
    status: str
    lines: tuple[bytes, ...]
    n_bytes: int


@dataclass(frozen=True, slots=True)
class StreamEcho:
    """What the echo of a running measurement says; `remaining` scans follow, 0 also where there is no end."""

    command: str
    start: int
    end: int
    cluster: int
    interval: int
    remaining: int


@dataclass(frozen=True, slots=True)
class Scan:
    """One scan: the raw clock, values (n,), and which of them stood in a block whose check failed (n,)."""

    timestamp: int
    values: IntArray
    damaged: BoolArray
    damaged_bytes: int


def stream_echo(echo: str) -> StreamEcho | None:
    """Return what an echo of MD, MS, ME, ND or NE says; None for any other."""
    match = _STREAM_ECHO.fullmatch(echo.split(";", 1)[0])
    return StreamEcho(match[1], *map(int, match.groups()[1:])) if match else None


def n_steps(start: int, end: int, cluster: int) -> int:
    """Return how many values a scan of these steps has."""
    return -(-(end - start + 1) // max(cluster, 1))


def info_fields(lines: tuple[bytes, ...]) -> tuple[dict[str, str], int]:
    """Return the fields of VV, PP or II, and how many of their sums are wrong.

    Real firmware has been seen to send a wrong sum in VV: a matter for a warning, not for a refusal.
    """
    fields, wrong = {}, 0
    for line in lines:
        body, check = line[:-1], line[-1:]
        text = body.removesuffix(b";").decode("ascii", "replace")
        key, colon, value = text.partition(":")
        if not colon or not key.isalnum():
            wrong += 1
            continue
        wrong += check not in (bytes([check_character(body)]), bytes([check_character(body.removesuffix(b";"))]))
        fields[key] = value
    return fields, wrong


def scan_of(answer: Reply, width: int, n_values: int) -> Scan | None:
    """Return the scan in a reply, of `n_values` values of `width` characters; None when it cannot be told.

    A block whose check fails, or whose length is wrong, costs its own values and no others. For ME and GE the values
    are distances and intensities by turns, so twice as many.
    """
    n_chars = n_values * width
    n_blocks = -(-n_chars // BLOCK_CHARS)
    if len(answer.lines) != n_blocks + 1 or len(answer.lines[0]) != 5 or not _is_sound(answer.lines[0]):
        return None
    timestamp = int(decode_values(answer.lines[0][:-1], 4)[0])
    characters = bytearray()
    damaged = np.zeros(n_chars, dtype=np.bool_)
    damaged_bytes = 0
    for block, line in enumerate(answer.lines[1:]):
        length = min(BLOCK_CHARS, n_chars - block * BLOCK_CHARS)
        if len(line) == length + 1 and _is_sound(line):
            characters += line[:-1]
        else:
            damaged[len(characters) : len(characters) + length] = True
            damaged_bytes += len(line) + 1
            characters += b"0" * length
    one = 3 if width == STREAMS["ME"] else width
    bad: BoolArray = np.asarray(damaged.reshape(-1, one).any(axis=1))
    return Scan(timestamp, decode_values(bytes(characters), one), bad, damaged_bytes)


def _is_sound(line: bytes) -> bool:
    """True when a data line's check agrees and all its characters are of the 64."""
    return (
        len(line) > 1
        and line[-1] == check_character(line[:-1])
        and min(line[:-1]) >= _FIRST
        and max(line[:-1]) <= _LAST
    )


class ReplyDecoder:
    """Bytes from a sensor in, replies and damage out; keeps at most one reply's bytes.

    At any time: bytes received = `accepted_bytes` + bytes of damage + `padding_bytes` + `pending_bytes`.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._skipped_bytes = 0  # of a reply that has grown too long
        self._searched = 0
        self.accepted_bytes = 0
        self.padding_bytes = 0

    @property
    def pending_bytes(self) -> int:
        """Bytes received of which nothing can be said yet."""
        return len(self._buffer) + self._skipped_bytes

    def receive(self, data: bytes) -> list[Reply | Damage]:
        """Take the next bytes; return what they complete."""
        found: list[Reply | Damage] = []
        self._buffer += data
        while True:
            if not self._skipped_bytes:
                self._drop_padding()
            at = self._buffer.find(b"\n\n", max(0, self._searched - 1))
            if at < 0:
                break
            piece, n_bytes = bytes(self._buffer[:at]), self._skipped_bytes + at + 2
            too_long = n_bytes > MAX_REPLY_BYTES
            del self._buffer[: at + 2]
            self._searched = self._skipped_bytes = 0
            found.append(Damage(DamageReason.TOO_LONG, n_bytes) if too_long else self._judge(piece, n_bytes))
        self._searched = len(self._buffer)
        if self.pending_bytes > MAX_REPLY_BYTES:
            self._skipped_bytes += len(self._buffer) - 1
            del self._buffer[:-1]
            self._searched = 1
        return found

    def reset(self) -> int:
        """Forget the reply under way; return how many bytes that were."""
        n_bytes = self.pending_bytes
        self._buffer.clear()
        self._skipped_bytes = self._searched = 0
        return n_bytes

    def _drop_padding(self) -> None:
        """Line ends in front of a reply belong to none."""
        n_bytes = len(self._buffer) - len(self._buffer.lstrip(b"\n"))
        if n_bytes:
            del self._buffer[:n_bytes]
            self.padding_bytes += n_bytes
            self._searched = 0

    def _judge(self, piece: bytes, n_bytes: int) -> Reply | Damage:
        echo, *rest = piece.split(b"\n")
        if not rest or not echo.isascii() or not echo.decode("ascii").isprintable():
            return Damage(DamageReason.BAD_LAYOUT, n_bytes)
        status = rest[0]
        if len(status) not in (1, 3) or not status.isascii():  # SCIP 1.1 has one character and no sum
            return Damage(DamageReason.BAD_LAYOUT, n_bytes)
        if len(status) == 3 and status[-1] != check_character(status[:-1]):
            return Damage(DamageReason.BAD_SUM, n_bytes)
        self.accepted_bytes += n_bytes
        text = status.decode("ascii")
        return Reply(echo.decode("ascii"), text[:2] if len(text) == 3 else text, tuple(rest[1:]), n_bytes)
