"""SICK's telegrams of the LMS2xx scanners, both halves of the wire: telegrams, their own CRC, measured values, status.

It decides nothing: `lms_host.py` has the manners. Facts: SICK telegram listing 8007954. Everything is little endian.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from drivers.protocols.framing import DamageReason
from drivers.protocols.prefixed import PrefixedDecoder
from drivers.scanline import BoolArray, Float64Array

STX = 0x02
ACK = 0x06
NAK = 0x15
MAX_TELEGRAM_BYTES = 814
"""401 values with everything around them are 812, and two more with their indices."""
_OVERHEAD_BYTES = 6  # STX, address, length, CRC: what the length does not count
REPLY_BIT = 0x80
PASSWORD = b"SICK_LMS"


class Command(IntEnum):
    """Requests; a reply has 80h added, save that a reset is answered by 91h and, when it is over, by 90h."""

    RESET = 0x10
    MODE = 0x20
    VALUES = 0x30
    STATUS = 0x31
    TYPE = 0x3A
    VARIANT = 0x3B
    PERMANENT_RATE = 0x66
    READ_CONFIGURATION = 0x74
    WRITE_CONFIGURATION = 0x77


class Reply(IntEnum):
    """Replies that are not just a request's with 80h added."""

    POWER_ON = 0x90
    RESETTING = 0x91
    NOT_NOW = 0x92
    VALUES = 0xB0


class Mode(IntEnum):
    """What command 20h may switch to."""

    INSTALLATION = 0x00
    STREAM = 0x24
    ON_REQUEST = 0x25
    STREAM_PARTIAL = 0x2A
    """Each turn's values as they are measured, where a whole scan is put together of several turns."""
    RATE_38400 = 0x40
    RATE_19200 = 0x41
    RATE_9600 = 0x42
    RATE_500000 = 0x48


RATE_MODES = {38_400: Mode.RATE_38400, 19_200: Mode.RATE_19200, 9_600: Mode.RATE_9600, 500_000: Mode.RATE_500000}
UNITS_MM = {0: 10.0, 1: 1.0}
"""Millimetres of one count, by the unit's code."""
DISTANCE_BITS = {0: 13, 1: 13, 2: 13, 3: 14, 4: 14, 5: 15, 6: 15, 0x0F: 15}
"""Bits of a value that are distance, by measuring mode; those above are flags."""
_NO_RETURN = {
    0xF: "nothing_came_back",
    0xE: "dazzled",
    0xD: "overflow",
    0xB: "signal_to_noise",
    0xA: "channel_1",
    0x7: "beyond_range",
}


def crc(data: bytes | bytearray) -> int:
    """Return the check of a telegram, STX to status byte; a polynomial 8005h that also feeds on the byte before."""
    register = previous = 0
    for byte in data:
        register = (register & 0x7FFF) << 1 ^ 0x8005 if register & 0x8000 else register << 1
        register ^= byte | previous << 8
        previous = byte
    return register


def telegram(address: int, command: int, data: bytes = b"") -> bytes:
    """Return a whole telegram; a reply's status byte is the last of `data`."""
    body = struct.pack("<BBHB", STX, address, 1 + len(data), command) + data
    if len(body) + 2 > MAX_TELEGRAM_BYTES:
        raise ValueError(f"a telegram has at most {MAX_TELEGRAM_BYTES} bytes, not {len(body) + 2}")
    return body + struct.pack("<H", crc(body))


def mode_request(mode: int, data: bytes = b"") -> bytes:
    """Return the request to switch the mode, to whatever scanner is there."""
    return telegram(0, Command.MODE, bytes([mode]) + data)


def variant_request(angle_deg: int, resolution_hundredths: int) -> bytes:
    """Return the request for another field of view and resolution."""
    return telegram(0, Command.VARIANT, struct.pack("<HH", angle_deg, resolution_hundredths))


@dataclass(frozen=True, slots=True)
class Telegram:
    """An intact telegram. Of a reply `data` is without the status byte, which is None in a request."""

    address: int
    command: int
    data: bytes
    status: int | None
    n_bytes: int


@dataclass(frozen=True, slots=True)
class Control:
    """A single byte between telegrams: ACK or NAK."""

    byte: int


@dataclass(frozen=True, slots=True)
class Values:
    """What a B0 telegram carries: `raw` (n,) counts with their flags, mm of one count, and where the first one lies.

    `partial_deg` is the quarter of a degree by which a partial scan's angles are moved, None for a whole scan. The two
    indices count scans and telegrams modulo 256; None where the scanner is not set to append them.
    """

    raw: npt.NDArray[np.int64]
    unit_mm: float
    partial_deg: float | None
    scan_index: int | None
    telegram_index: int | None


@dataclass(frozen=True, slots=True)
class ScannerStatus:
    """What a B1 telegram says, as far as measuring needs it."""

    software: str
    mode: int
    has_fault: bool
    measuring_mode: int
    angle_deg: int
    resolution_hundredths: int
    unit: int


@dataclass(frozen=True, slots=True)
class Configuration:
    """The 34 bytes of F4 and 77h, of which three matter to measuring."""

    data: bytes

    @property
    def appends_indices(self) -> bool:
        """True when scan and telegram index follow the values."""
        return bool(self.data[4] & 0x02)

    @property
    def measuring_mode(self) -> int:
        """Which bits of a value are flags."""
        return self.data[5]

    @property
    def unit(self) -> int:
        """0 centimetres, 1 millimetres."""
        return self.data[6]


def read_values(data: bytes) -> Values:
    """Return the content of a B0 telegram, without its status byte; raises ValueError when its length is wrong."""
    (word,) = struct.unpack_from("<H", data)
    count, rest = word & 0x3FF, len(data) - 2 - 2 * (word & 0x3FF)
    if rest not in (0, 2) or word >> 14 not in UNITS_MM:
        raise ValueError(f"{len(data)} bytes do not hold {count} values")
    raw = np.frombuffer(data, dtype="<u2", count=count, offset=2).astype(np.int64)
    partial = (word >> 11 & 3) * 0.25 if word >> 13 & 1 else None
    indices = tuple(data[-2:]) if rest else (None, None)
    return Values(raw, UNITS_MM[word >> 14], partial, indices[0], indices[1])


def values_data(values: Values) -> bytes:
    """Return the content of a B0 telegram, without its status byte."""
    unit = next(code for code, mm in UNITS_MM.items() if mm == values.unit_mm)
    partial = 0 if values.partial_deg is None else 1 << 13 | int(values.partial_deg * 4) << 11
    data = struct.pack("<H", len(values.raw) | partial | unit << 14) + values.raw.astype("<u2").tobytes()
    if values.scan_index is not None and values.telegram_index is not None:
        data += bytes([values.scan_index, values.telegram_index])
    return data


def distances_of(values: Values, measuring_mode: int) -> tuple[Float64Array, dict[str, BoolArray]]:
    """Return distances in mm (n,), and for each reason why there is none where it holds (n,)."""
    bits = DISTANCE_BITS.get(measuring_mode, 13)
    counts = values.raw & (1 << bits) - 1
    first_code = (1 << bits) - 9  # the last nine values are codes
    reasons = {name: counts == (1 << bits) - 0x10 + low for low, name in _NO_RETURN.items()}
    reasons["other_code"] = counts >= first_code
    return counts.astype(np.float64) * values.unit_mm, reasons


def read_status(data: bytes) -> ScannerStatus:
    """Return the content of a B1 telegram; raises ValueError when it is too short. Offsets count from the B1 byte."""
    if len(data) < 122:
        raise ValueError(f"a status has 122 bytes or more, not {len(data)}")
    angle, resolution = struct.unpack_from("<HH", data, 106)
    return ScannerStatus(
        software=data[0:7].decode("ascii", "replace").strip(),
        mode=data[7],
        has_fault=data[8] != 0,
        measuring_mode=data[101],
        angle_deg=angle,
        resolution_hundredths=resolution,
        unit=data[121],
    )


def first_angle_deg(angle_deg: int) -> float:
    """Return where the first value lies, 90 being straight ahead: a field of 100 degrees begins at 40."""
    return 90.0 - angle_deg / 2


class TelegramDecoder(PrefixedDecoder[Telegram | Control]):
    """Bytes of one direction in, telegrams, ACK, NAK and damage out."""

    failed_check = DamageReason.BAD_CRC

    def __init__(self, *, from_host: bool = False) -> None:
        super().__init__()
        self._from_host = from_host

    def _length(self, buffer: bytearray) -> int | None:
        if buffer[0] != STX or (len(buffer) > 1 and (buffer[1] >= REPLY_BIT) == self._from_host):
            return 0
        if len(buffer) < 4:
            return None
        length = (buffer[2] | buffer[3] << 8) + _OVERHEAD_BYTES
        shortest = _OVERHEAD_BYTES + (1 if self._from_host else 2)
        return length if shortest <= length <= MAX_TELEGRAM_BYTES else 0

    def _read(self, whole: bytes) -> Telegram | None:
        if crc(whole[:-2]) != int.from_bytes(whole[-2:], "little"):
            return None
        content = whole[5:-2]
        if self._from_host:
            return Telegram(whole[1], whole[4], content, None, len(whole))
        return Telegram(whole[1], whole[4], content[:-1], content[-1], len(whole))

    def _lone(self, byte: int) -> Control | None:
        return Control(byte) if byte in (ACK, NAK) else None
