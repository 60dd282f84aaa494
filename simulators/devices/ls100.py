"""A Profiler 2's or LS-100's half of its protocol: requests in, replies out, time passed in; knows no pty.

Its memory is words: at the profile's address the size, three words more, then x and y of each point. Reading the size
freezes the profile until it is read again.
"""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from drivers.protocols.framing import Damage
from drivers.protocols.ls100 import (
    HEADER_WORDS,
    NO_MEASUREMENT,
    POINT_WORDS,
    PROFILE_ADDRESS,
    READ,
    SET_SHUTTER,
    TIME_SPAN,
    TIME_TICK_S,
    FrameDecoder,
    frame,
    header_data,
)
from drivers.scanline import Float64Array

LineScene: TypeAlias = Callable[[float], tuple[Float64Array, Float64Array]]
"""x and z (n,) in mm, that long in seconds after the sensor was first asked; NaN = no measurement."""

_ADDRESS = 0x03062000
_REPLY_DELAY_S = 204e-6


class Ls100Device:
    """One sensor.

    Parameters
    ----------
    scene : what it sees.
    baud_rate : set at the sensor only.
    sends_time : which of the two readings of the manual it follows.
    is_measuring : whether it is in a state in which settings are refused.
    """

    laser_on = True

    def __init__(
        self,
        scene: LineScene,
        *,
        baud_rate: int = 115_200,
        sends_time: bool = False,
        is_measuring: bool = False,
    ) -> None:
        self.baud_rate = baud_rate
        self.profiles_frozen = 0
        self.shutter = 200
        self._scene = scene
        self._sends_time = sends_time
        self._is_measuring = is_measuring
        self._ear = FrameDecoder()
        self._out = bytearray()
        self._ready_s = 0.0
        self._heard_s = 0.0
        self._since_s: float | None = None
        self._words = np.zeros(0, dtype=np.int64)

    def receive(self, data: bytes, now_s: float) -> None:
        """Take bytes from the host; what is no frame is answered by an error once the line is quiet."""
        self._heard_s = now_s
        for item in self._ear.receive(data):
            if not isinstance(item, Damage):
                self._obey(item.command, item.data, now_s)
        if self._ear.has_failed_check:
            self._ear.reset()
            self._reply(0xE004, b"", now_s)

    def transmit(self, now_s: float, room_bytes: int) -> bytes:
        """At most `room_bytes` of what there is to send by now."""
        if self._ear.has_begun and now_s - self._heard_s > 0.05 + 6000 / self.baud_rate:
            self._ear.reset()
            self._reply(0xE003, b"", now_s)
        if now_s < self._ready_s:
            return b""
        sent = bytes(self._out[:room_bytes])
        del self._out[:room_bytes]
        return sent

    def next_due_s(self, now_s: float) -> float | None:
        """When there is next something to send."""
        if self._out:
            return max(now_s, self._ready_s)
        return now_s + 0.01 if self._ear.has_begun else None

    def _reply(self, command: int, data: bytes, now_s: float) -> None:
        self._out += frame(command, data)
        self._ready_s = now_s + _REPLY_DELAY_S

    def _obey(self, command: int, data: bytes, now_s: float) -> None:
        if command == PROFILE_ADDRESS and not data:
            self._reply(command, _ADDRESS.to_bytes(4, "big"), now_s)
        elif command == READ and len(data) == 6:
            self._read(int.from_bytes(data[:4], "big"), data[4], data[5] >> 4, data[5] & 0xF, now_s)
        elif command == SET_SHUTTER and len(data) == 2:
            if self._is_measuring:
                self._reply(0xE008, b"", now_s)
                return
            self.shutter = int.from_bytes(data, "big")
            self._reply(command, b"", now_s)
        else:
            self._reply(0xE002 if command in (READ, PROFILE_ADDRESS, SET_SHUTTER) else 0xE001, b"", now_s)

    def _read(self, address: int, count: int, words: int, step: int, now_s: float) -> None:
        at = address - _ADDRESS
        if at == 0 and (count, words) == (1, 1):
            self._freeze(now_s)
            n_points = (len(self._words) - HEADER_WORDS) // POINT_WORDS
            time = round((now_s - (self._since_s or 0.0)) / TIME_TICK_S) % TIME_SPAN if self._sends_time else None
            self._reply(READ, header_data(address, n_points, time), now_s)
            return
        starts = at + np.arange(count) * words * max(step, 1)
        places = (starts[:, None] + np.arange(words)).reshape(-1)
        if not count or not words or 2 + count * words > 255 or places.min() < 0 or places.max() >= len(self._words):
            self._reply(0xE002, b"", now_s)
            return
        self._reply(READ, address.to_bytes(4, "big") + self._words[places].astype(">i2").tobytes(), now_s)

    def _freeze(self, now_s: float) -> None:
        if self._since_s is None:
            self._since_s = now_s
        x_mm, z_mm = self._scene(now_s - self._since_s)
        xz = np.stack([x_mm, z_mm], axis=1) * 1000.0
        with np.errstate(invalid="ignore"):
            seen = (np.abs(xz) < NO_MEASUREMENT).all(axis=1, keepdims=True)
            counts = np.where(seen, np.rint(xz), NO_MEASUREMENT).astype(np.int64)
        self._words = np.concatenate([np.zeros(HEADER_WORDS, dtype=np.int64), counts.reshape(-1)])
        self.profiles_frozen += 1
