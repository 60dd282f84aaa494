"""A SICK LMS2xx's half of its telegrams: requests in, replies and values out, time passed in; knows no pty.

It has the scanner's manners: ACK before each reply, NAK for a wrong check, silence for another's address, a request
interrupts what is being sent, and scans that the line has no time for are left out.
"""

import struct
from collections import deque

import numpy as np

from drivers.protocols.framing import Damage, DamageReason
from drivers.protocols.lms import (
    ACK,
    DISTANCE_BITS,
    NAK,
    PASSWORD,
    RATE_MODES,
    REPLY_BIT,
    UNITS_MM,
    Command,
    Mode,
    Reply,
    Telegram,
    TelegramDecoder,
    Values,
    first_angle_deg,
    telegram,
    values_data,
)
from simulators.sweep import RangeScene

_TURN_S = 0.01332
_TYPE = b"LMS200;000000;V00.01 "
_OK = 0x10
_BOOT_S = 1.0
_BYTE_GAP_S = 0.006
_CONFIGURATION = bytes.fromhex("0000 7000 02 04 01 00 00 02 02") + bytes(23)
_RATES = {int(mode): rate for rate, mode in RATE_MODES.items()}
_STREAMS = (Mode.STREAM, Mode.STREAM_PARTIAL)
_TURNS = {100: 1, 50: 2, 25: 4}
"""Turns of the mirror that make a whole scan, by resolution in 1/100 degree."""


class LmsDevice:
    """One scanner.

    Parameters
    ----------
    scene : what it sees.
    variant : (field of view in degrees, resolution in 1/100 degree).
    appends_indices : whether scan and telegram index follow the values.
    miss_rate : chance that it misses a request, as a real one does in parts of a turn.
    address : its own; 0 reaches every scanner.
    """

    def __init__(
        self,
        scene: RangeScene,
        *,
        rng: np.random.Generator,
        variant: tuple[int, int] = (180, 50),
        appends_indices: bool = True,
        miss_rate: float = 0.0,
        address: int = 1,
        can_change_variant: bool = True,
    ) -> None:
        self.baud_rate = 9_600
        self.laser_on = True
        self.status = _OK
        """The status byte of all replies."""
        self.scans_made = 0
        self.scans_sent = 0
        self._scene = scene
        self._rng = rng
        self._variant = variant
        self._miss_rate = miss_rate
        self._address = address
        self._can_change_variant = can_change_variant
        self._ear = TelegramDecoder(from_host=True)
        self._configuration = bytearray(_CONFIGURATION)
        if not appends_indices:
            self._configuration[4] = 0
        self._mode = int(Mode.ON_REQUEST)
        self._may_configure = False
        self._out = bytearray()
        self._later: deque[tuple[float, bytes]] = deque()
        self._rate_after: int | None = None
        self._scan_index = 0
        self._telegram_index = 0
        self._next_s = 0.0
        self._since_s = 0.0
        self._heard_s = 0.0

    # ---- the port -------------------------------------------------------------------------------------------------

    def receive(self, data: bytes, now_s: float) -> None:
        """Take bytes from the host; a request whose bytes come too far apart is forgotten."""
        if data and self._ear.has_begun and now_s - self._heard_s > _BYTE_GAP_S + 10 * len(data) / self.baud_rate:
            self._ear.reset()
        self._heard_s = now_s
        for item in self._ear.receive(data):
            if isinstance(item, Damage) and item.reason is DamageReason.BAD_CRC:
                self._out += bytes([NAK])
            elif isinstance(item, Telegram) and item.address in (0, self._address):
                if self._rng.random() < self._miss_rate:
                    continue
                self._out.clear()
                self._out += bytes([ACK])
                self._obey(item.command, item.data, now_s)
        if self._ear.has_failed_check:
            self._ear.reset()
            self._out += bytes([NAK])

    def transmit(self, now_s: float, room_bytes: int) -> bytes:
        """At most `room_bytes` of what there is to send by now.

        What the line had time for since the last call was sent meanwhile: a scan finds the line as that leaves it.
        """
        while self._later and self._later[0][0] <= now_s:
            self._out += self._later.popleft()[1]
        sent = self._send(room_bytes)
        self._measure(now_s)
        return sent + self._send(room_bytes - len(sent))

    def _send(self, room_bytes: int) -> bytes:
        sent = bytes(self._out[:room_bytes])
        del self._out[:room_bytes]
        if not self._out and self._rate_after is not None:
            self.baud_rate, self._rate_after = self._rate_after, None
        return sent

    def next_due_s(self, now_s: float) -> float | None:
        """When there is next something to send."""
        if self._out:
            return now_s
        due = [self._later[0][0]] if self._later else []
        if self._mode in _STREAMS:
            due.append(max(now_s, self._next_s))
        return min(due, default=None)

    # ---- requests -------------------------------------------------------------------------------------------------

    def _reply(self, command: int, data: bytes = b"") -> None:
        self._out += telegram(self._address | REPLY_BIT, command, data + bytes([self.status]))

    def _obey(self, command: int, data: bytes, now_s: float) -> None:
        match command:
            case Command.MODE if data:
                self._switch(data[0], data[1:], now_s)
            case Command.TYPE:
                self._reply(command + REPLY_BIT, _TYPE)
            case Command.STATUS:
                self._reply(command + REPLY_BIT, self._status())
            case Command.VARIANT if len(data) == 4:
                angle, resolution = struct.unpack("<HH", data)
                possible = angle in (100, 180) and resolution in ((25, 50, 100) if angle == 100 else (50, 100))
                done = possible and self._can_change_variant
                if done:
                    self._variant = (angle, resolution)
                self._reply(command + REPLY_BIT, bytes([done]) + struct.pack("<HH", *self._variant))
            case Command.VALUES if data[:1] == b"\x01" and self._mode == Mode.ON_REQUEST:
                self._out += self._scan(now_s)
            case Command.READ_CONFIGURATION:
                self._reply(command + REPLY_BIT, bytes(self._configuration))
            case Command.WRITE_CONFIGURATION if self._may_configure and len(data) == len(self._configuration):
                self._configuration = bytearray(data)
                self._reply(command + REPLY_BIT, b"\x01" + data)
            case Command.PERMANENT_RATE if data in (b"\0", b"\1"):
                self._reply(command + REPLY_BIT, data)
            case Command.RESET:
                self._reply(Reply.RESETTING)
                self._later.append(
                    (now_s + _BOOT_S, telegram(self._address | REPLY_BIT, Reply.POWER_ON, _TYPE + bytes([self.status])))
                )
                self._mode = int(Mode.ON_REQUEST)
                self._may_configure = False
                self._rate_after = 9_600
            case _:
                self._reply(Reply.NOT_NOW)

    def _switch(self, mode: int, data: bytes, now_s: float) -> None:
        if mode == Mode.INSTALLATION:
            good = data == PASSWORD
            self._may_configure = good
            self._reply(Command.MODE + REPLY_BIT, bytes([not good]))
            return
        if mode in _RATES:
            self._reply(Command.MODE + REPLY_BIT, b"\0")
            self._rate_after = _RATES[mode]
            return
        if mode not in (*_STREAMS, Mode.ON_REQUEST):
            self._reply(Command.MODE + REPLY_BIT, b"\2")
            return
        is_new, self._mode = mode != self._mode, mode
        if mode in _STREAMS and is_new:
            self._next_s = now_s + self._scan_s
            self._since_s = self._next_s
        self._may_configure = False
        self._reply(Command.MODE + REPLY_BIT, b"\0")

    def _status(self) -> bytes:
        """The 152 bytes of a status; offsets count from the byte B1, which is not among them."""
        data = bytearray(151)
        data[0:7] = b"V00.01 "
        data[7] = self._mode
        data[101] = self._configuration[5]
        data[106:110] = struct.pack("<HH", *self._variant)
        data[119] = self._address
        data[121] = self._configuration[6]
        return bytes(data)

    # ---- measuring ------------------------------------------------------------------------------------------------

    @property
    def _scan_s(self) -> float:
        return _TURN_S * (1 if self._mode == Mode.STREAM_PARTIAL else _TURNS[self._variant[1]])

    def _measure(self, now_s: float) -> None:
        while self._mode in _STREAMS and self._next_s <= now_s:
            at_s = self._next_s
            self._next_s += self._scan_s
            self.scans_made += 1
            if self._out:  # the line is still busy with the last one
                self._scan_index = (self._scan_index + 1) % 256
                continue
            self._out += self._scan(at_s)

    def _scan(self, at_s: float) -> bytes:
        angle, resolution = self._variant
        degrees = first_angle_deg(angle) + resolution / 100 * np.arange(angle * 100 // resolution + 1) - 90.0
        partial_deg = None
        if self._mode == Mode.STREAM_PARTIAL:
            turn = self._scan_index % _TURNS[resolution]
            degrees, partial_deg = degrees[turn :: _TURNS[resolution]], turn * resolution / 100
        unit = self._configuration[6]
        nothing = (1 << DISTANCE_BITS[self._configuration[5]]) - 1
        counts = np.rint(self._scene(np.radians(degrees), at_s - self._since_s) / UNITS_MM[unit])
        with np.errstate(invalid="ignore"):
            raw = np.where((counts >= 0) & (counts < nothing - 15), counts, nothing).astype(np.int64)
        indexed = bool(self._configuration[4] & 2)
        values = Values(
            raw,
            UNITS_MM[unit],
            partial_deg,
            self._scan_index if indexed else None,
            self._telegram_index if indexed else None,
        )
        self._scan_index = (self._scan_index + 1) % 256
        self._telegram_index = (self._telegram_index + 1) % 256
        self.scans_sent += 1
        return telegram(self._address | REPLY_BIT, Reply.VALUES, values_data(values) + bytes([self.status]))
