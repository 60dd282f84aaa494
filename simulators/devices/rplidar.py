"""An RPLIDAR's half of its protocol: requests in, samples and capsules out, time passed in; knows no pty and no optics.

It has a lidar's manners: any request ends a scan, in the protection stop no scan begins, and a reset prints a greeting
over the same line. A pseudo-terminal has no DTR, so its motor turns whenever it is asked to scan.
"""

import math
import struct
from dataclasses import dataclass

import numpy as np

from drivers.protocols.rplidar import (
    DENSE_SAMPLES,
    EXPRESS_SAMPLES,
    LENGTHS,
    Answer,
    Capsule,
    Command,
    Conf,
    RequestDecoder,
    Sample,
    capsule_bytes,
    descriptor,
    sample_bytes,
)
from drivers.protocols.rplidar_ultra import ULTRA_SAMPLES, look_aside_deg, ultra_bytes
from drivers.scanline import Float64Array
from simulators.sweep import RangeScene

_BUFFER_BYTES = 8_192
_BANNER = b"RP LIDAR System.\r\nFirmware Ver 1.29, HW Ver 7\r\nModel: simulated\r\n"
_BOOT_S = 0.5
_QUALITY = 47
_SAMPLES_AT_ONCE = 4_000
_ROUNDS, _AGREE_MM = 8, 0.5
_OFFSETS_Q3 = np.array([0, 3, 1, 2])  # by turns; only that they are not all zero matters


@dataclass(frozen=True, slots=True)
class ScanMode:
    """A mode as GET_LIDAR_CONF describes it."""

    name: str
    kind: int
    us_per_sample: float
    max_m: float


@dataclass(frozen=True, slots=True)
class Model:
    """A type of lidar: its number, firmware (major, minor), hardware, and what it knows."""

    number: int
    firmware: tuple[int, int]
    hardware: int
    baud_rate: int
    modes: tuple[ScanMode, ...]
    typical: int
    motor_needs_pwm: bool = False


A1 = Model(
    24,
    (1, 29),
    7,
    115_200,
    (ScanMode("Standard", Answer.STANDARD, 508.0, 12.0), ScanMode("Express", Answer.EXPRESS, 254.0, 12.0)),
    1,
)
A1_OLD = Model(24, (1, 15), 7, 115_200, (ScanMode("Standard", Answer.STANDARD, 508.0, 6.0),), 0)
A2 = Model(
    44,
    (1, 20),
    5,
    256_000,
    (ScanMode("Standard", Answer.STANDARD, 250.0, 12.0), ScanMode("Express", Answer.EXPRESS, 125.0, 12.0)),
    1,
    True,
)
A3 = Model(
    49,
    (1, 26),
    7,
    256_000,
    (ScanMode("Standard", Answer.STANDARD, 250.0, 12.0), ScanMode("Sensitivity", Answer.ULTRA, 62.5, 25.0)),
    1,
    True,
)
S1 = Model(
    97,
    (1, 28),
    18,
    256_000,
    (ScanMode("Standard", Answer.STANDARD, 244.0, 40.0), ScanMode("DenseBoost", Answer.DENSE, 108.7, 40.0)),
    1,
)


class RplidarDevice:
    """One lidar.

    Parameters
    ----------
    scene : what it sees.
    model : its type.
    serial : its serial number, 16 bytes.
    turn_hz : turns a second.
    health : (status, code); a status of 2 is the protection stop, which one reset ends unless `is_stuck`.
    """

    def __init__(
        self,
        scene: RangeScene,
        model: Model = A1,
        *,
        serial: bytes = bytes(range(0x10, 0x20)),
        turn_hz: float = 10.0,
        health: tuple[int, int] = (0, 0),
        is_stuck: bool = False,
    ) -> None:
        self.baud_rate = model.baud_rate
        self.model = model
        self.health = health
        self.motor_pwm = 0
        self.dropped_samples = 0
        """Samples for which the line had no room."""
        self._scene = scene
        self._serial = serial
        self._turn_hz = turn_hz
        self._is_stuck = is_stuck
        self._ear = RequestDecoder()
        self._out = bytearray()
        self._mode: ScanMode | None = None
        self._since_s = 0.0
        self._sample = 0
        self._is_first = True
        self._booting_until_s: float | None = None

    @property
    def laser_on(self) -> bool:
        """True while it scans."""
        return self._mode is not None

    def receive(self, data: bytes, now_s: float) -> None:
        """Take bytes from the host."""
        self._wake(now_s)
        for command, payload in self._ear.receive(data):
            if self._booting_until_s is None:
                self._obey(command, payload, now_s)

    def transmit(self, now_s: float, room_bytes: int) -> bytes:
        """At most `room_bytes` of what there is to send by now."""
        self._wake(now_s)
        self._measure(now_s)
        sent = bytes(self._out[:room_bytes])
        del self._out[:room_bytes]
        return sent

    def next_due_s(self, now_s: float) -> float | None:
        """When there is next something to send."""
        if self._out:
            return now_s
        if self._booting_until_s is not None:
            return self._booting_until_s
        return None if self._mode is None else max(now_s, self._due_s(self._sample + self._batch))

    def _wake(self, now_s: float) -> None:
        if self._booting_until_s is not None and now_s >= self._booting_until_s:
            self._booting_until_s = None
            self._out += _BANNER

    def _obey(self, command: int, payload: bytes, now_s: float) -> None:
        if command != Command.SET_MOTOR_PWM:
            self._mode = None  # any request ends a scan
        modes = {mode.kind: mode for mode in self.model.modes}
        match command:
            case Command.STOP:
                self._out.clear()
            case Command.RESET:
                self._out.clear()
                self._booting_until_s = now_s + _BOOT_S
                if not self._is_stuck:
                    self.health = (0, 0)
            case Command.GET_INFO:
                major, minor = self.model.firmware
                self._answer(Answer.INFO, bytes([self.model.number, minor, major, self.model.hardware]) + self._serial)
            case Command.GET_HEALTH:
                self._answer(Answer.HEALTH, struct.pack("<BH", *self.health))
            case Command.GET_SAMPLERATE if self.model.firmware >= (1, 17):
                last = self.model.modes[-1]
                self._answer(
                    Answer.SAMPLERATE,
                    struct.pack("<HH", int(self.model.modes[0].us_per_sample), int(last.us_per_sample)),
                )
            case Command.GET_LIDAR_CONF if self.model.firmware >= (1, 24):
                self._configuration(payload)
            case Command.SET_MOTOR_PWM if len(payload) == 2:
                self.motor_pwm = int.from_bytes(payload, "little")
            case Command.SCAN | Command.FORCE_SCAN:
                self._start(modes[Answer.STANDARD], 5, now_s)
            case Command.EXPRESS_SCAN if len(payload) == 5 and len(self.model.modes) > 1:
                numbered = self.model.modes[payload[0]] if payload[0] < len(self.model.modes) else None
                # number 0 is the legacy express scan, whatever the list of modes says
                wanted = modes.get(Answer.EXPRESS, numbered) if payload[0] == 0 else numbered
                if wanted is not None:
                    self._start(wanted, LENGTHS[Answer(wanted.kind)], now_s)

    def _answer(self, kind: int, data: bytes) -> None:
        self._out += descriptor(kind, len(data), many=False) + data

    def _configuration(self, payload: bytes) -> None:
        if len(payload) < 4:
            return
        what = int.from_bytes(payload[:4], "little")
        number = int.from_bytes(payload[4:6], "little")
        mode = self.model.modes[number] if number < len(self.model.modes) else None
        match what:
            case Conf.DESIRED_TURNS:
                value = struct.pack("<HH", round(self._turn_hz * 60), 660)
            case Conf.MODE_COUNT:
                value = struct.pack("<H", len(self.model.modes))
            case Conf.TYPICAL_MODE:
                value = struct.pack("<H", self.model.typical)
            case Conf.US_PER_SAMPLE if mode is not None:
                value = struct.pack("<I", round(mode.us_per_sample * 256))
            case Conf.MAX_DISTANCE if mode is not None:
                value = struct.pack("<I", round(mode.max_m * 256))
            case Conf.ANSWER_TYPE if mode is not None:
                value = bytes([mode.kind])
            case Conf.NAME if mode is not None:
                value = mode.name.encode() + b"\0"
            case _:
                return
        self._answer(Answer.CONF, payload[:4] + value)

    def _start(self, mode: ScanMode, length: int, now_s: float) -> None:
        if self.health[0] == 2:
            return
        self._out += descriptor(mode.kind, length, many=True)
        self._mode = mode
        self._since_s = now_s
        self._sample = 0
        self._is_first = True

    @property
    def _batch(self) -> int:
        """Samples of one packet."""
        kinds = {Answer.EXPRESS: EXPRESS_SAMPLES, Answer.DENSE: DENSE_SAMPLES, Answer.ULTRA: ULTRA_SAMPLES}
        return 1 if self._mode is None else kinds.get(Answer(self._mode.kind), 1)

    def _due_s(self, sample: int) -> float:
        assert self._mode is not None
        return self._since_s + sample * self._mode.us_per_sample * 1e-6

    def _measure(self, now_s: float) -> None:
        """Measure all that is due; what finds no room on the line is dropped, as a lidar does, without a word."""
        mode = self._mode
        if mode is None or (self.model.motor_needs_pwm and self.motor_pwm == 0):
            return
        due = int((now_s - self._since_s) / (mode.us_per_sample * 1e-6))
        n = min((due - self._sample) // self._batch * self._batch, _SAMPLES_AT_ONCE // self._batch * self._batch)
        if n <= 0:
            return
        numbers = (self._sample + np.arange(n)).astype(np.float64)
        self._sample += n
        turns: Float64Array = numbers * mode.us_per_sample * 1e-6 * self._turn_hz
        if mode.kind == Answer.STANDARD:
            self._send_samples(turns)
        elif mode.kind == Answer.ULTRA:
            for at in range(0, n, self._batch):
                self._send_ultra(turns[at : at + self._batch])
        else:
            for at in range(0, n, self._batch):
                self._send_capsule(turns[at : at + self._batch], mode)

    def _ranges(self, clockwise_turns: Float64Array) -> Float64Array:
        """Ranges in mm, 0 where nothing comes back."""
        assert self._mode is not None
        angles_rad = -2 * np.pi * ((clockwise_turns + 0.5) % 1.0 - 0.5)
        ranges = self._scene(angles_rad, float(clockwise_turns[0]) / self._turn_hz)
        with np.errstate(invalid="ignore"):
            return np.where(ranges <= self._mode.max_m * 1000, ranges, 0.0)

    def _send_samples(self, turns: Float64Array) -> None:
        ranges = self._ranges(turns)
        angles_q6 = np.floor(turns % 1.0 * 360 * 64).astype(int)
        starts = np.floor(turns) != np.floor(
            np.concatenate([[turns[0] - (turns[1] - turns[0] if len(turns) > 1 else 1e-4)], turns[:-1]])
        )
        for angle, distance, starts_turn in zip(angles_q6.tolist(), ranges.tolist(), starts.tolist(), strict=True):
            quality = _QUALITY if distance else 0
            self._send(sample_bytes(Sample(starts_turn, quality, angle, min(round(distance * 4), 0xFFFF))), 1)

    def _send_capsule(self, turns: Float64Array, mode: ScanMode) -> None:
        n = len(turns)
        offsets = np.zeros(n, dtype=np.int64) if mode.kind == Answer.DENSE else np.resize(_OFFSETS_Q3, n)
        ranges = self._ranges(turns - offsets / 8 / 360)
        limit = 0xFFFF if mode.kind == Answer.DENSE else 0x3FFF
        start_q6 = math.floor(float(turns[0]) % 1.0 * 360 * 64)
        capsule = Capsule(mode.kind, start_q6, self._is_first, np.minimum(np.rint(ranges), limit), offsets)
        self._is_first = False
        self._send(capsule_bytes(capsule), n)

    def _send_ultra(self, turns: Float64Array) -> None:
        """The beam leaves beside the axis: where it looks depends on how far it gets, which a few rounds find.

        At the edges of what it sees they may find nothing that agrees with itself: then nothing comes back.
        """
        step = turns[1] - turns[0]
        places = np.append(turns, turns[-1] + step)  # the first sample of the next capsule, too
        ranges = np.zeros(len(places))
        before = ranges
        for _ in range(_ROUNDS):
            before, ranges = ranges, np.nan_to_num(self._ranges(places - look_aside_deg(ranges) / 360))
        ranges = np.where(np.abs(ranges - before) < _AGREE_MM, ranges, 0.0)
        start_q6 = math.floor(float(turns[0]) % 1.0 * 360 * 64)
        self._send(ultra_bytes(start_q6, ranges[:-1], float(ranges[-1]), is_first=self._is_first), len(turns))
        self._is_first = False

    def _send(self, packet: bytes, n_samples: int) -> None:
        if len(self._out) + len(packet) > _BUFFER_BYTES:
            self.dropped_samples += n_samples
        else:
            self._out += packet
