"""The host's half of a conversation with a SICK LMS2xx: find its rate, let it stream, make profiles; no port.

Nothing is written to the scanner's EEPROM: mode, rate and variant hold until it is switched off.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.errors import ScannerRefused, ScannerSilent, ScannerTimeout
from drivers.protocols.conversation import Conversation, Listener
from drivers.protocols.device_clock import DeviceClock
from drivers.protocols.dialogue import Answer, Pause, Quiet, Script
from drivers.protocols.framing import Damage, DamageReason
from drivers.protocols.lms import (
    ACK,
    NAK,
    RATE_MODES,
    REPLY_BIT,
    UNITS_MM,
    Command,
    Configuration,
    Control,
    Mode,
    Reply,
    ScannerStatus,
    Telegram,
    TelegramDecoder,
    Values,
    distances_of,
    first_angle_deg,
    mode_request,
    read_status,
    read_values,
    telegram,
    variant_request,
)
from drivers.protocols.polar import reasons_of, sensor_from_polar
from drivers.scanline import DeviceInfo, SensorGeometry

RATES = (9_600, 38_400, 500_000, 19_200)
TURN_S = 0.01332
_ACK_S = 0.25
_REPLY_S = 1.0
_MODE_S = 3.5
_AFTER_NAK_S = 0.035
_TRIES = 4
_BITS_PER_BYTE = 10
_INDEX_SPAN = 256


@dataclass(frozen=True, slots=True)
class LmsOptions:
    """How to read a scanner.

    Parameters
    ----------
    variant : (field of view in degrees, resolution in 1/100 degree) to switch to: 180 or 100, and 100, 50 or, with
        100 degrees, 25. None takes what is set.
    work_rate : baud rate to switch to where the scanner answers at a lower one; 500,000 needs RS-422. None stays.
    field_of_view_rad : (lowest, highest) angle that is handed on, 0 ahead, counter-clockwise; None is all.
    partial_scans : take the values of each turn of the mirror as a profile of its own, a degree apart, instead of whole
        scans that are put together of two or four turns. A moving part is then not smeared over several turns.
    """

    variant: tuple[int, int] | None = None
    work_rate: int | None = 38_400
    field_of_view_rad: tuple[float, float] | None = None
    partial_scans: bool = False

    def __post_init__(self) -> None:
        if self.work_rate is not None and self.work_rate not in RATE_MODES:
            raise ValueError(f"an LMS2xx has the rates {', '.join(map(str, sorted(RATES)))}, not {self.work_rate}")
        if self.variant not in (None, (180, 100), (180, 50), (100, 100), (100, 50), (100, 25)):
            raise ValueError(f"an LMS2xx cannot measure {self.variant}: (180 or 100 degrees, 100, 50 or 25 hundredths)")
        if self.field_of_view_rad is not None and not self.field_of_view_rad[0] < self.field_of_view_rad[1]:
            raise ValueError("the field of view must be (lowest, highest) angle")


class LmsHost(Conversation):
    """One conversation with one LMS2xx. Between two bytes of a telegram it pauses for 14 ms at most."""

    break_after_s = 0.15

    def __init__(self, listener: Listener, rates: tuple[int, ...] = RATES, options: LmsOptions | None = None) -> None:
        self._frames = TelegramDecoder()
        super().__init__(listener, self._frames, rates)
        self._options = options or LmsOptions()
        self._status: ScannerStatus | None = None
        self._measuring_mode = 0
        self._scan_s = TURN_S
        self._clock = DeviceClock(_INDEX_SPAN, TURN_S)
        self._last: tuple[int, int] | None = None  # scan number and telegram index of the profile before
        self._last_pass = 0
        self._dropped_lines = 0
        self._told_status = 0

    def _break_off(self) -> Sequence[Any]:
        return self._frames.break_off()

    # ---- scripts --------------------------------------------------------------------------------------------------

    def _greet(self) -> Script[DeviceInfo]:
        yield from self._find_rate(self._quieten)
        yield from self._switch_rate()
        kind = yield from self._request(telegram(0, Command.TYPE), Command.TYPE)
        if self._options.variant is not None:
            yield from self._switch_variant(*self._options.variant)
        status = yield from self._ask_status()
        configuration = yield from self._request(telegram(0, Command.READ_CONFIGURATION), Command.READ_CONFIGURATION, 2)
        self._measuring_mode = status.measuring_mode
        if configuration is not None and len(configuration.data) >= 7:
            self._measuring_mode = Configuration(configuration.data).measuring_mode
        if status.has_fault:
            self._advise("the scanner reports a fault of its own; see the lamps on its front")
        self._status = status
        turns = 1 if self._options.partial_scans else {100: 1, 50: 2, 25: 4}.get(status.resolution_hundredths, 1)
        self._scan_s = TURN_S * turns
        self._clock = DeviceClock(_INDEX_SPAN, self._scan_s) if not self.is_met else self._clock
        self.laser_on = True  # it measures for as long as it has power
        name, part, firmware = (
            *(b"" if kind is None else kind.data).decode("ascii", "replace").split(";"),
            "",
            "",
            "",
        )[:3]
        return DeviceInfo(
            device_id=f"{name.strip() or 'LMS2xx'}-{part.strip()}",
            model=name.strip() or "LMS2xx",
            firmware=firmware.strip() or status.software,
            calibration_id="factory",
            boot_id=self.boot_id,
            points_per_line=(
                status.angle_deg + 1
                if self._options.partial_scans
                else status.angle_deg * 100 // status.resolution_hundredths + 1
            ),
            geometry=SensorGeometry(np.zeros(3), np.zeros(3), (-8191.0 * UNITS_MM.get(status.unit, 10.0), 0.0), 0.0),
        )

    def _nobody(self, tried: str, *, heard: bool) -> str:
        if heard:
            return f"what comes at {tried} baud is not an LMS2xx's; check the cable (RS-232 or RS-422)"
        return f"no LMS2xx answers at {tried} baud; check its power (24 V; it wakes up for 60 s) and cable"

    def _quieten(self) -> Script[bool]:
        """Let it send on request only; True when a scanner did so at this rate."""
        question = mode_request(Mode.ON_REQUEST)
        for _ in range(2):
            self._say(question)
            answer = yield Answer(lambda item: item == Control(ACK) or _replies(item, Command.MODE), _ACK_S)
            if answer == Control(ACK):
                answer = yield Answer(lambda item: _replies(item, Command.MODE), _MODE_S)
            if answer is not None:
                yield Quiet(0.05, 1.0)
                self._decoder.reset()
                return True
        return False

    def _request(
        self, question: bytes, command: int, tries: int = _TRIES, within_s: float = _REPLY_S
    ) -> Script[Telegram | None]:
        """Ask, again where the scanner missed it or got it damaged; None when it never answers."""
        for _ in range(tries):
            self._say(question)
            answer = yield Answer(
                lambda item: (
                    item == Control(NAK) or _replies(item, command) or _replies(item, Reply.NOT_NOW - REPLY_BIT)
                ),
                within_s,
            )
            if isinstance(answer, Telegram):
                return answer if answer.command == command + REPLY_BIT else None
            if answer is not None:
                yield Pause(_AFTER_NAK_S)
        return None

    def _ask_status(self) -> Script[ScannerStatus]:
        answer = yield from self._request(telegram(0, Command.STATUS), Command.STATUS)
        if answer is None:
            raise ScannerSilent("the scanner acknowledged, but did not tell its status; switch it off and on")
        try:
            status = read_status(answer.data)
        except ValueError as error:
            raise ScannerRefused(f"the scanner's status cannot be read: {error}") from error
        if status.angle_deg not in (100, 180) or status.resolution_hundredths not in (25, 50, 100):
            raise ScannerRefused(
                f"the scanner says it measures {status.angle_deg} degrees in steps of "
                f"{status.resolution_hundredths}/100 degree: that is no LMS2xx's"
            )
        return status

    def _switch_rate(self) -> Script[None]:
        """Go to the rate to work at, where that is higher; the reply still comes at the old one."""
        old, new = self.baud_rate, self._options.work_rate
        if new is None or new <= old:
            return
        answer = yield from self._request(mode_request(RATE_MODES[new]), Command.MODE, within_s=_MODE_S)
        if answer is None or answer.data[:1] != b"\0":
            self._advise(f"the scanner stays at {old} baud: it did not agree to {new}")
            return
        yield from self._settle_at(new, old, self._quieten)

    def _switch_variant(self, angle_deg: int, resolution: int) -> Script[None]:
        answer = yield from self._request(variant_request(angle_deg, resolution), Command.VARIANT, within_s=_MODE_S)
        if answer is None or answer.data[:1] != b"\1":
            raise ScannerRefused(
                f"the scanner refused {angle_deg} degrees in steps of {resolution}/100 degree; "
                "models -S14 cannot change it"
            )

    def _begin(self) -> Script[None]:
        assert self._status is not None and self.info is not None
        wire_s = (self.info.points_per_line * 2 + 12) * _BITS_PER_BYTE / self.baud_rate
        left_out = math.ceil(wire_s / self._scan_s) - 1
        if left_out > 0:
            self._advise(
                f"at {self.baud_rate} baud one scan takes {wire_s:.3g} s on the line and comes every "
                f"{self._scan_s:.3g} s: the scanner leaves out {left_out} of {left_out + 1}; use RS-422 at 500000 baud "
                "or a coarser resolution"
            )
        self.silent_after_s = max(2.0, 5 * max(wire_s, self._scan_s))
        mode = Mode.STREAM_PARTIAL if self._options.partial_scans else Mode.STREAM
        answer = yield from self._request(mode_request(mode), Command.MODE, within_s=_MODE_S)
        if answer is None:
            raise ScannerTimeout("the scanner does not acknowledge the request to measure; check power and cable")
        if answer.data[:1] != b"\0":
            raise ScannerRefused(f"the scanner refused to measure (code {answer.data[:1].hex()})")

    def _end(self) -> Script[None]:
        for _ in range(2):
            if (yield from self._quieten()):
                return
        raise ScannerTimeout("the scanner does not acknowledge the stop and may still be sending")

    # ---- the stream -----------------------------------------------------------------------------------------------

    def _take(self, item: Any, now_s: float) -> None:
        if not isinstance(item, Telegram) or item.command != Reply.VALUES:
            return
        try:
            values = read_values(item.data)
        except (ValueError, IndexError):
            self._damage(Damage(DamageReason.BAD_LAYOUT, item.n_bytes))
            return
        self._watch_status(item.status or 0)
        device_time_s = self._number(values, now_s)
        if not self._account.enter(self._dropped_lines):
            return
        assert self._status is not None
        range_mm, reasons = distances_of(values, self._measuring_mode)
        step_deg = self._status.resolution_hundredths / 100 if values.partial_deg is None else 1.0
        first_deg = first_angle_deg(self._status.angle_deg) + (values.partial_deg or 0.0)
        angle_rad = np.radians(first_deg + step_deg * np.arange(len(range_mm)) - 90.0)
        if self._options.field_of_view_rad is not None:
            lowest, highest = self._options.field_of_view_rad
            inside = (angle_rad >= lowest) & (angle_rad <= highest)
            angle_rad, range_mm = angle_rad[inside], range_mm[inside]
            reasons = {name: holds[inside] for name, holds in reasons.items()}
        counts = reasons_of(range_mm, reasons)
        x_mm, z_mm = sensor_from_polar(range_mm, angle_rad)
        self._profile(x_mm, z_mm, np.zeros(len(x_mm), dtype=np.bool_), device_time_s, now_s, counts)

    def _number(self, values: Values, now_s: float) -> float:
        """Enter what is missing before these values; return the scanner's time of them.

        The scan index is a clock of one scan's period; by what it advances more than the telegram index, the scanner
        has left scans out itself. Without indices there is no clock, and what the line lost cannot be told.
        """
        if values.scan_index is None or values.telegram_index is None:
            self._last = None
            return now_s
        device_time_s = self._clock.read(values.scan_index, now_s)
        self._jumped(self._clock.jumps)
        scan = round(device_time_s / self._scan_s)
        if self._last is not None and self._last_pass == self.pass_index:
            scans = max(1, scan - self._last[0])
            telegrams = (values.telegram_index - self._last[1]) % _INDEX_SPAN or _INDEX_SPAN
            if scans < _INDEX_SPAN:  # beyond that the telegram index has come round
                self._dropped_lines += max(0, scans - min(telegrams, scans))
            self._account.lost(scans - 1)
        self._last, self._last_pass = (scan, values.telegram_index), self.pass_index
        return device_time_s

    def _watch_status(self, status: int) -> None:
        """Tell when severity or pollution changes for the worse."""
        told, self._told_status = self._told_status, status & 0x87
        if status & 0x07 >= 2 and status & 0x07 > told & 0x07:
            self._advise(f"the scanner reports a fault of severity {status & 0x07} of 4")
        if status & 0x80 and not told & 0x80:
            self._advise("the scanner's front window is dirty; clean it")


def _replies(item: Any, command: int) -> bool:
    return isinstance(item, Telegram) and item.command == command + REPLY_BIT
