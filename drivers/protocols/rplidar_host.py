"""The host's half of the RPLIDAR protocol: meet a lidar, choose a scan mode, make profiles of its turns; no port.

A lidar is asked only for what its firmware is known to have. Its motor is switched both ways that models have: by DTR
(A1: cleared means on) and by a command (A2, A3); later models turn by themselves.
"""

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.errors import ScannerRefused, ScannerTimeout
from drivers.protocols.conversation import Conversation, Listener
from drivers.protocols.device_clock import DeviceClock
from drivers.protocols.dialogue import Answer as Awaited
from drivers.protocols.dialogue import Pause, Quiet, Script
from drivers.protocols.framing import Damage, DamageReason
from drivers.protocols.polar import reasons_of, sensor_from_polar
from drivers.protocols.rplidar import (
    SAMPLE_BYTES,
    STREAMS,
    Answer,
    AnswerDecoder,
    AnyCapsule,
    Command,
    Conf,
    Descriptor,
    Packet,
    Sample,
    conf_request,
    request,
)
from drivers.protocols.rplidar_turns import Turn, TurnCollector
from drivers.scanline import DeviceInfo, SensorGeometry

RATES = (115_200, 256_000, 460_800, 1_000_000)
USUAL_PWM = 660
_ANSWER_S = 0.3
_QUIET_S = 0.1
_NOTHING = -1  # what STOP and RESET are answered by
_SPIN_UP_S = 6.0
_MAX_MODES = 16
_COUNTER = 1 << 48  # samples are counted by the host: the counter never wraps
_USUAL_RANGE_MM = 12_000.0
_USUAL_TURN_HZ = 10.0
_FAMILIES = {1: "A1", 2: "A2", 3: "A3", 4: "C1", 6: "S1", 7: "S2", 8: "S3"}


@dataclass(frozen=True, slots=True)
class RplidarOptions:
    """How to read a lidar.

    Parameters
    ----------
    mode : `auto` takes the lidar's own choice, or express where it names none; else `standard`, `express`, or the name
        of one of its modes.
    field_of_view_rad : (lowest, highest) angle that is handed on, 0 ahead, counter-clockwise; None is the whole turn.
    motor_pwm : speed for models whose motor has a command, 0 to 1023.
    signed_offsets : how the angle offsets of express capsules are read; the manufacturer reads them unsigned.
    """

    mode: str = "auto"
    field_of_view_rad: tuple[float, float] | None = None
    motor_pwm: int = USUAL_PWM
    signed_offsets: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.motor_pwm <= 1023:
            raise ValueError(f"motor_pwm must be 0 to 1023, not {self.motor_pwm}")
        if self.field_of_view_rad is not None and not self.field_of_view_rad[0] < self.field_of_view_rad[1]:
            raise ValueError("the field of view must be (lowest, highest) angle")


@dataclass(frozen=True, slots=True)
class Mode:
    """One way of measuring; `number` None is the standard scan, which has no number."""

    name: str
    kind: int
    us_per_sample: float
    max_mm: float
    number: int | None = None

    @property
    def request(self) -> bytes:
        """What starts it."""
        if self.kind == Answer.STANDARD:
            return request(Command.SCAN)
        return request(Command.EXPRESS_SCAN, struct.pack("<BHH", self.number or 0, 0, 0))


class RplidarHost(Conversation):
    """One conversation with one RPLIDAR."""

    silent_after_s = 2.0

    def __init__(
        self, listener: Listener, rates: tuple[int, ...] = RATES, options: RplidarOptions | None = None
    ) -> None:
        self._options = options or RplidarOptions()
        self._answers = AnswerDecoder(signed_offsets=self._options.signed_offsets)
        super().__init__(listener, self._answers, rates)
        self._turns = TurnCollector()
        self._mode: Mode | None = None
        self._unread: dict[str, int] = {}  # modes whose answers are not understood, by name
        self._has_pwm = False
        self._turn_s = 1.0 / _USUAL_TURN_HZ
        self._clock = DeviceClock(_COUNTER, 1e-6)
        self._told_implausible = 0
        self.dtr = True  # the motor rests

    def _decode(self, data: bytes, now_s: float) -> list[Any]:
        found = self._answers.receive(data)
        if self._streaming:
            for item in found:
                if isinstance(item, Damage):
                    self._turns.lost_bytes(item.n_bytes)
                elif isinstance(item, Sample | AnyCapsule) and self._dialogue is None:
                    self._collect(item, now_s)
        return [item for item in found if not isinstance(item, Sample | AnyCapsule)]

    def _reset_decoder(self) -> list[Damage]:
        self._turns.forget()
        return super()._reset_decoder()

    # ---- scripts --------------------------------------------------------------------------------------------------

    def _greet(self) -> Script[DeviceInfo]:
        info = yield from self._find_rate(self._identify)
        model, minor, major, hardware = info[:4]
        self._has_pwm = model >> 4 in (2, 3)
        yield from self._check_health()
        modes = yield from self._ask_modes((major, minor), model)
        self._mode = mode = self._choose(modes)
        self.laser_on = False
        family = _FAMILIES.get(model >> 4, "of unknown family")
        return DeviceInfo(
            device_id=info[4:].hex().upper(),
            model=f"RPLIDAR {family}, model {model}",
            firmware=f"{major}.{minor:02d}",
            calibration_id=f"hardware {hardware}, mode {mode.name}",
            boot_id=self.boot_id,
            points_per_line=max(1, round(1e6 / mode.us_per_sample / _USUAL_TURN_HZ)),
            geometry=SensorGeometry(np.zeros(3), np.zeros(3), (-mode.max_mm, 0.0), 0.0),
        )

    def _nobody(self, tried: str, *, heard: bool) -> str:
        if heard:
            return f"what comes at {tried} baud is not an RPLIDAR's; check the model's rate and the cable"
        return f"no RPLIDAR answers at {tried} baud; check its power (a weak USB port is not enough)"

    def _identify(self) -> Script[bytes | None]:
        """Stop whatever runs, and ask who is there at this rate."""
        for _ in range(2):
            self._ask(request(Command.STOP))
            yield Quiet(_QUIET_S, 1.0)
            self._decoder.reset()
            packet = yield from self._packet(request(Command.GET_INFO), Answer.INFO)
            if packet is not None:
                return packet
        return None

    def _packet(self, question: bytes, kind: int) -> Script[bytes | None]:
        """Ask for a single answer; None when none comes."""
        self._ask(question, kind)
        packet = yield Awaited(lambda item: isinstance(item, Packet) and item.kind == kind, _ANSWER_S)
        return None if packet is None else packet.data

    def _ask(self, question: bytes, kind: int = _NOTHING) -> None:
        self._answers.expect(kind)
        self._say(question)

    def _health(self) -> Script[tuple[int, int] | None]:
        """Return status and error code."""
        for _ in range(3):
            packet = yield from self._packet(request(Command.GET_HEALTH), Answer.HEALTH)
            if packet is not None:
                return packet[0], int.from_bytes(packet[1:3], "little")
        return None

    def _check_health(self) -> Script[None]:
        """In its protection stop a lidar measures nothing until it is reset; it then prints a greeting first."""
        health = yield from self._health()
        if health is not None and health[0] == 2:
            self._advise(f"the lidar was in its protection stop (code {health[1]:04X}h) and has been reset")
            self._ask(request(Command.RESET))
            yield Pause(1.0)
            yield Quiet(_QUIET_S, 3.0)
            self._decoder.reset()
            health = yield from self._health()
        if health is None:
            raise ScannerTimeout("the lidar said who it is, but not how it is; switch it off and on")
        if health[0] >= 2:
            raise ScannerRefused(f"the lidar is in its protection stop (code {health[1]:04X}h): is its motor blocked?")
        if health[0] == 1:
            self._advise(f"the lidar warns of its health (code {health[1]:04X}h)")

    def _ask_modes(self, firmware: tuple[int, int], model: int) -> Script[list[Mode]]:
        """Ask for the scan modes as far as the firmware knows such questions; the first one is the lidar's choice."""
        standard = Mode("standard", Answer.STANDARD, 508.0, _USUAL_RANGE_MM)
        is_late = model >> 4 >= 4
        if not is_late and firmware < (1, 17):
            return [standard]
        packet = yield from self._packet(request(Command.GET_SAMPLERATE), Answer.SAMPLERATE)
        express_us = 254.0
        if packet is not None:
            standard_us, express_us = (max(1.0, float(us)) for us in struct.unpack("<HH", packet))
            standard = Mode("standard", Answer.STANDARD, standard_us, _USUAL_RANGE_MM)
        if not is_late and firmware < (1, 24):
            return [Mode("express", Answer.EXPRESS, express_us, _USUAL_RANGE_MM, 0), standard]
        count = yield from self._conf("<H", Conf.MODE_COUNT)
        typical = yield from self._conf("<H", Conf.TYPICAL_MODE)
        modes = []
        for number in range(min(count or 0, _MAX_MODES)):
            mode = yield from self._ask_mode(number)
            if mode is not None:
                modes.append(mode)
        modes.sort(key=lambda mode: (mode.number != typical, mode.kind == Answer.STANDARD))
        return modes if any(mode.kind == Answer.STANDARD for mode in modes) else [*modes, standard]

    def _ask_mode(self, number: int) -> Script[Mode | None]:
        """One mode; None for one whose packets this driver cannot read, or which the lidar does not describe."""
        kind = yield from self._conf("<B", Conf.ANSWER_TYPE, number)
        us_q8 = yield from self._conf("<I", Conf.US_PER_SAMPLE, number)
        far_q8 = yield from self._conf("<I", Conf.MAX_DISTANCE, number)
        name = yield from self._packet(conf_request(Conf.NAME, number), Answer.CONF)
        text = (name or b"")[4:].split(b"\0")[0].decode("ascii", "replace") or f"mode {number}"
        if kind not in STREAMS or not us_q8:
            if kind is not None:
                self._unread[text.lower()] = kind
            return None
        far_mm = far_q8 / 256 * 1000 if far_q8 else _USUAL_RANGE_MM
        return Mode(text, kind, us_q8 / 256, far_mm, None if kind == Answer.STANDARD else number)

    def _conf(self, layout: str, what: int, mode: int | None = None) -> Script[int | None]:
        """One number of the configuration; None when the answer is another's, or does not come."""
        packet = yield from self._packet(conf_request(what, mode), Answer.CONF)
        if packet is None or int.from_bytes(packet[:4], "little") != what or len(packet) < 4 + struct.calcsize(layout):
            return None
        return int(struct.unpack_from(layout, packet, 4)[0])

    def _choose(self, modes: list[Mode]) -> Mode:
        wanted = self._options.mode.lower()
        if wanted == "auto":
            return modes[0]
        for mode in modes:
            if mode.name.lower() == wanted or (wanted == "express" and mode.kind != Answer.STANDARD):
                return mode
        names = ", ".join(dict.fromkeys(mode.name for mode in modes))
        if wanted in self._unread:
            raise ScannerRefused(
                f"mode {self._options.mode!r} of this lidar sends answers of type {self._unread[wanted]:02X}h, "
                f"which this driver does not read; choose one of {names}"
            )
        raise ScannerRefused(f"this lidar has no mode {self._options.mode!r}; its modes are {names}")

    def _begin(self) -> Script[None]:
        mode = self._mode
        assert mode is not None
        self.laser_on = None
        self.dtr = False
        if self._has_pwm:
            self._say(request(Command.SET_MOTOR_PWM, struct.pack("<H", self._options.motor_pwm)))
        for _ in range(2):
            self._turns.forget()
            self._ask(mode.request, mode.kind)
            answer = yield Awaited(lambda item: isinstance(item, Descriptor) and item.kind == mode.kind, 2.0)
            if answer is not None:
                self.laser_on = True
                self.silent_after_s = _SPIN_UP_S
                return
            self._ask(request(Command.STOP))
            yield Quiet(_QUIET_S, 1.0)
        health = yield from self._health()
        self.dtr = True
        if health is not None and health[0] >= 2:
            raise ScannerRefused(f"the lidar is in its protection stop (code {health[1]:04X}h): is its motor blocked?")
        raise ScannerTimeout(f"the lidar does not begin to scan in mode {mode.name}; check its power")

    def _end(self) -> Script[None]:
        """There is no answer to a stop: what shows it is that an answer to something else comes alone."""
        self.laser_on = None
        for _ in range(3):
            self._say(request(Command.STOP))
            yield Quiet(0.05, 0.5)
            self._decoder.reset()
            if (yield from self._packet(request(Command.GET_HEALTH), Answer.HEALTH)) is not None:
                if self._has_pwm:
                    self._say(request(Command.SET_MOTOR_PWM, struct.pack("<H", 0)))
                self.dtr = True
                self.laser_on = False
                return
        raise ScannerTimeout("the lidar does not answer after the stop; its laser may be on")

    # ---- the stream -----------------------------------------------------------------------------------------------

    def _take(self, item: Any, now_s: float) -> None:
        """All that comes while it streams is taken as it is decoded."""

    def _collect(self, item: Sample | AnyCapsule, now_s: float) -> None:
        """Take a sample or a capsule, and the turn that it ends."""
        turn = self._turns.sample(item) if isinstance(item, Sample) else self._turns.capsule(item)
        if self._turns.implausible > self._told_implausible:
            self._damage(Damage(DamageReason.BAD_LAYOUT, SAMPLE_BYTES))
            self._told_implausible = self._turns.implausible
        if turn is not None:
            self._take_turn(turn, now_s)

    def _take_turn(self, turn: Turn, now_s: float) -> None:
        assert self._mode is not None
        us = self._mode.us_per_sample
        device_time_s = self._clock.read(round(turn.first_sample * us), now_s)
        self._jumped(self._clock.jumps)
        self._account.lost_by_time(device_time_s, self._turn_s)
        if not turn.missing.any():
            self._turn_s = len(turn.angle_rad) * us * 1e-6
            self.silent_after_s = max(2.0, 5 * self._turn_s)
        if not self._account.enter():
            return
        angle_rad, range_mm, missing = turn.angle_rad, turn.range_mm.copy(), turn.missing
        if self._options.field_of_view_rad is not None:
            lowest, highest = self._options.field_of_view_rad
            inside = ((angle_rad >= lowest) & (angle_rad <= highest)) | missing
            angle_rad, range_mm, missing = angle_rad[inside], range_mm[inside], missing[inside]
        counts = reasons_of(range_mm, {"no_return": range_mm == 0.0, "beyond_range": range_mm > self._mode.max_mm})
        x_mm, z_mm = sensor_from_polar(range_mm, angle_rad)
        self._profile(x_mm, z_mm, missing.copy(), device_time_s, now_s, counts)
