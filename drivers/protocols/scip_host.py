"""The host's half of SCIP 2.0: meet a Hokuyo lidar, choose rate and request, make profiles of its scans; no port.

What it asks for is only what the sensor announced (PP), because old firmware locks up on what it does not know.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivers.errors import ScannerRefused, ScannerSilent, ScannerTimeout
from drivers.protocols.conversation import Conversation
from drivers.protocols.device_clock import DeviceClock
from drivers.protocols.dialogue import Answer, Quiet, Script
from drivers.protocols.framing import Damage, DamageReason
from drivers.protocols.polar import reasons_of, sensor_from_polar
from drivers.protocols.scanner_events import ScannerEvent
from drivers.protocols.scip import (
    BLOCK_CHARS,
    CLOCK_SPAN,
    CLOCK_TICK_S,
    SCANNING,
    STREAMS,
    Reply,
    ReplyDecoder,
    Scan,
    info_fields,
    n_steps,
    scan_of,
    stream_echo,
)
from drivers.protocols.scip_echoes import ECHO_STREAMS, NONE, EchoScan, echoes_of
from drivers.scanline import DeviceInfo, Profile, SensorGeometry

RATES = (115_200, 19_200, 38_400, 57_600, 250_000, 500_000, 750_000)
QUIET_S = 0.14
"""Silence after which a stale stream is taken to have ended; Hokuyo's own client waits as long."""
_ANSWER_S = 0.4
_STALE_S = 2.5  # a scan that was under way at 19200 baud takes more than a second to arrive
_BITS_PER_BYTE = 10
_MAX_INTERVAL = 9
_CODES = 32  # no model has more codes; a nearest distance beyond them must not make more reasons
_WIDTHS = STREAMS | ECHO_STREAMS
_LINE_SHARE = 0.95  # of the line's time that scans may fill: replies and a slow motor need the rest


@dataclass(frozen=True, slots=True)
class ScipOptions:
    """What to ask a lidar for.

    Parameters
    ----------
    field_of_view_rad : (lowest, highest) angle, 0 ahead, counter-clockwise; None is all the sensor has.
    command : `MD` distances of three characters, `MS` of two (up to 4,095 mm), `ME` with intensities; of newer models
        `ND` with several echoes a step, `NE` the same with intensities.
    echo : which of several echoes counts: `first`, `last`, or the `strongest`, which needs `NE`.
    cluster : neighbouring steps merged into one value, the smallest distance of them.
    interval : scans left out between two, 0 to 9; None is as few as the line has time for, and says so.
    work_rate : baud rate to switch to where the sensor answers at a lower one; None stays.
    """

    field_of_view_rad: tuple[float, float] | None = None
    command: str = "MD"
    cluster: int = 1
    interval: int | None = None
    work_rate: int | None = 115_200
    echo: str = "first"

    def __post_init__(self) -> None:
        if self.command not in _WIDTHS:
            raise ValueError(f"a lidar is asked with one of {', '.join(_WIDTHS)}, not {self.command!r}")
        needed = {"first": tuple(_WIDTHS), "last": ("ND", "NE"), "strongest": ("NE",)}.get(self.echo)
        if needed is None:
            raise ValueError(f"echo must be first, last or strongest, not {self.echo!r}")
        if self.command not in needed:
            raise ValueError(f"the {self.echo} echo is told with command {' or '.join(needed)}, not {self.command}")
        if not 1 <= self.cluster <= 99:
            raise ValueError(f"cluster must be 1 to 99, not {self.cluster}")
        if self.interval is not None and not 0 <= self.interval <= _MAX_INTERVAL:
            raise ValueError(f"interval must be 0 to {_MAX_INTERVAL}, not {self.interval}")
        if self.field_of_view_rad is not None and not self.field_of_view_rad[0] < self.field_of_view_rad[1]:
            raise ValueError("the field of view must be (lowest, highest) angle")
        if self.work_rate is not None and self.work_rate not in RATES:
            raise ValueError(f"SCIP has the rates {', '.join(map(str, sorted(RATES)))}, not {self.work_rate}")


@dataclass(frozen=True, slots=True)
class Parameters:
    """What PP says: distances in mm, steps of a turn, and the motor's turns a minute."""

    model: str
    min_mm: int
    max_mm: int
    steps_per_turn: int
    first_step: int
    last_step: int
    front_step: int
    rpm: int

    @property
    def period_s(self) -> float:
        """Seconds of one turn."""
        return 60.0 / self.rpm

    def step_at(self, angle_rad: float) -> int:
        """The step nearest to an angle, kept within those there are."""
        step = self.front_step + round(angle_rad * self.steps_per_turn / math.tau)
        return min(max(step, self.first_step), self.last_step)


@dataclass(frozen=True, slots=True)
class _Request:
    """The measurement that was asked for."""

    command: str
    start: int
    end: int
    cluster: int
    interval: int

    @property
    def text(self) -> str:
        return f"{self.command}{self.start:04d}{self.end:04d}{self.cluster:02d}{self.interval}00"

    @property
    def n_values(self) -> int:
        return n_steps(self.start, self.end, self.cluster)


def scan_bytes(command: str, n_values: int) -> int:
    """Return the bytes of one scan on the wire: echo, status, time, blocks of 64 with sum and end, empty line.

    Of ND and NE with one echo a step; each further one is a character more than the first.
    """
    n_chars = n_values * _WIDTHS[command]
    return 16 + 4 + 6 + n_chars + 2 * -(-n_chars // BLOCK_CHARS) + 1


class ScipHost(Conversation):
    """One conversation with one Hokuyo lidar."""

    def __init__(
        self,
        deliver: Callable[[Profile], bool],
        emit: Callable[[ScannerEvent], None],
        boot_id: int,
        rates: tuple[int, ...] = RATES,
        options: ScipOptions | None = None,
    ) -> None:
        super().__init__(deliver, emit, ReplyDecoder(), boot_id=boot_id, rates=rates)
        self._options = options or ScipOptions()
        self._parameters: Parameters | None = None
        self._request: _Request | None = None
        self._angles_rad = np.empty(0)
        self._clock = DeviceClock(CLOCK_SPAN, CLOCK_TICK_S)
        self._dropped_lines = 0  # scans that the lidar made and had no time to send

    # ---- scripts --------------------------------------------------------------------------------------------------

    def _greet(self) -> Script[DeviceInfo]:
        yield from self._find_rate(self._quieten)
        version = yield from self._information("VV")
        parameters = _parameters((yield from self._information("PP")))
        yield from self._switch_rate()
        state = (yield from self._information("II", required=False)).get("STAT", "")
        if state and "well" not in state.lower() and not state.startswith("000"):
            self._advise(f"the lidar says of its state: {state}")
        self._parameters = parameters
        self.laser_on = False
        reach_mm = (-float(parameters.max_mm), -float(parameters.min_mm))
        return DeviceInfo(
            device_id=version.get("SERI") or "unknown serial number",
            model=parameters.model,
            firmware=version.get("FIRM", ""),
            calibration_id=version.get("PROD", ""),
            boot_id=self.boot_id,
            points_per_line=self._plan(parameters).n_values,
            geometry=SensorGeometry(np.zeros(3), np.zeros(3), reach_mm, 0.0),
        )

    def _nobody(self, tried: str, *, heard: bool) -> str:
        if heard:
            return f"what comes at {tried} baud is not SCIP 2.0; is this a Hokuyo lidar?"
        return f"no Hokuyo lidar answers at {tried} baud; check its power and the cable"

    def _quieten(self) -> Script[bool]:
        """Stop whatever runs; True when a sensor answered at this rate, and all it had to say is read."""
        for _ in range(2):
            before = self.heard_bytes
            self._say(b"\nQT\n")
            answer = yield Answer(_is_reply_to("QT"), _ANSWER_S)
            if answer is None and self.heard_bytes > before:  # an old stream's scan may still be in the way
                answer = yield Answer(_is_reply_to("QT"), _STALE_S)
            if answer is None:
                continue
            if answer.status in ("0E", "E"):
                self._say(b"TM2\n" if answer.status == "0E" else b"SCIP2.0\n")
                yield Quiet(QUIET_S, 1.0)
            yield Quiet(QUIET_S, 2.0)
            self._decoder.reset()
            return True
        return False

    def _information(self, command: str, *, required: bool = True) -> Script[dict[str, str]]:
        """Ask VV, PP or II; a wrong sum is asked again, and in the end only told."""
        best: dict[str, str] = {}
        for _ in range(3):
            self._say(command.encode() + b"\n")
            answer = yield Answer(_is_reply_to(command), 1.0)
            if answer is None or answer.status not in ("00", "0"):
                if not required:
                    return {}
                continue
            fields, wrong = info_fields(answer.lines)
            if len(fields) >= len(best):
                best = fields
            if not wrong and fields:
                return fields
        if best:
            self._advise(
                f"the lidar's answer to {command} has a wrong sum; its firmware is known to do so, or the line is bad"
            )
            return best
        if required:
            raise ScannerSilent(f"the lidar stopped, but did not answer {command}; switch it off and on")
        return {}

    def _switch_rate(self) -> Script[None]:
        """Go to the rate to work at, where that is higher; on USB the sensor says yes and nothing changes."""
        old, new = self.baud_rate, self._options.work_rate
        if new is None or new <= old:
            return
        command = f"SS{new:06d}"
        self._say(command.encode() + b"\n")
        answer = yield Answer(_is_reply_to(command), 1.0)
        if answer is None or answer.status not in ("00", "03"):
            why = "did not answer" if answer is None else f"said {answer.status}"
            self._advise(f"the lidar stays at {old} baud: asked for {new} it {why}")
            return
        yield from self._settle_at(new, old, self._quieten)

    def _begin(self) -> Script[None]:
        assert self._parameters is not None
        request = self._plan(self._parameters)
        self._check_bandwidth(request, self._parameters)
        self._request = request
        first = request.start + (request.cluster - 1) / 2
        steps = first + request.cluster * np.arange(request.n_values)
        self._angles_rad = (steps - self._parameters.front_step) * math.tau / self._parameters.steps_per_turn
        self.silent_after_s = max(2.0, 5 * self._period_s(request, self._parameters))
        for _ in range(2):
            self._say(request.text.encode() + b"\n")
            self.laser_on = None
            answer = yield Answer(lambda item: _is_reply_to(request.text)(item) and item.status != SCANNING, 2.0)
            if answer is not None and answer.status == "00":
                self.laser_on = True
                return
            if answer is not None:
                raise ScannerRefused(f"the lidar refused to measure: {_meaning(answer.status)}")
            yield from self._quieten()
        raise ScannerTimeout("the lidar does not acknowledge the request to measure; check power and cable")

    def _end(self) -> Script[None]:
        self.laser_on = None
        for _ in range(4):
            self._say(b"QT\n")
            answer = yield Answer(_is_reply_to("QT"), 1.0)
            if answer is not None:
                self.laser_on = False
                return
        raise ScannerTimeout("the lidar does not acknowledge the stop; its laser may be on")

    # ---- the stream -----------------------------------------------------------------------------------------------

    def _take(self, item: Any, now_s: float) -> None:
        request, parameters = self._request, self._parameters
        if not isinstance(item, Reply) or request is None or parameters is None:
            return
        echo = stream_echo(item.echo)
        if echo is None:  # a late answer to something else
            return
        if item.echo[:13] != request.text[:13]:
            self._damage(Damage(DamageReason.DEBRIS, item.n_bytes))
            return
        if item.status != SCANNING:
            self._take_status(item.status)
            return
        scan = self._read(item, request)
        if scan is None:
            self._damage(Damage(DamageReason.BAD_SUM, item.n_bytes))
            return
        device_time_s = self._clock.read(scan.timestamp, now_s)
        self._jumped(self._clock.jumps)
        self._dropped_lines += self._account.lost_by_time(device_time_s, self._period_s(request, parameters))
        if not self._account.enter(self._dropped_lines):
            return
        if scan.damaged_bytes:
            self._damage(Damage(DamageReason.BAD_SUM, scan.damaged_bytes))
        codes, missing = scan.values, scan.damaged
        range_mm = codes.astype(np.float64)
        range_mm[missing] = np.nan
        low = np.unique(codes[codes < min(parameters.min_mm, _CODES)]).tolist()
        reasons = {f"code {code}": codes == code for code in low}
        reasons |= {"below_range": codes < parameters.min_mm, "beyond_range": codes > parameters.max_mm}
        counts = reasons_of(range_mm, reasons)
        x_mm, z_mm = sensor_from_polar(range_mm, self._angles_rad)
        self._profile(x_mm, z_mm, missing.copy(), device_time_s, now_s, counts)

    def _read(self, answer: Reply, request: _Request) -> Scan | None:
        """The scan in a reply, a distance a step."""
        width = _WIDTHS[request.command]
        if request.command in ECHO_STREAMS:
            told = echoes_of(answer, width, request.n_values)
            return None if told is None else _one_echo(told, self._options.echo)
        scan = scan_of(answer, width, request.n_values)
        if scan is None or width != STREAMS["ME"]:
            return scan
        return replace(scan, values=scan.values[::2], damaged=scan.damaged[::2])

    def _take_status(self, status: str) -> None:
        if status.isdigit() and 50 <= int(status) <= 97:
            self._fault(f"the lidar has stopped: {_meaning(status)}")
        else:
            self._advise(f"the lidar says {_meaning(status)}")

    def _plan(self, parameters: Parameters) -> _Request:
        """The measurement to ask for; where the interval is free, the smallest that the line has time for."""
        options = self._options
        start, end = parameters.first_step, parameters.last_step
        if options.field_of_view_rad is not None:
            start, end = (parameters.step_at(angle) for angle in options.field_of_view_rad)
        request = _Request(options.command, start, end, options.cluster, options.interval or 0)
        if options.interval is not None:
            return request
        for interval in range(_MAX_INTERVAL + 1):
            request = _Request(options.command, start, end, options.cluster, interval)
            if self._wire_s(request) <= self._period_s(request, parameters) * _LINE_SHARE:
                break
        return request

    def _check_bandwidth(self, request: _Request, parameters: Parameters) -> None:
        wire_s, period_s = self._wire_s(request), self._period_s(request, parameters)
        remedy = "use a higher rate, MS instead of MD, a larger cluster, a smaller field of view or a larger interval"
        if wire_s > period_s:
            raise ScannerRefused(
                f"at {self.baud_rate} baud one scan takes {wire_s:.3g} s on the line and comes every {period_s:.3g} s; "
                + remedy
            )
        if self._options.interval is None and request.interval:
            self._advise(
                f"{request.interval} of {request.interval + 1} scans are left out: at {self.baud_rate} baud one takes "
                f"{wire_s:.3g} s on the line; {remedy.replace('a larger interval', 'fewer points')}"
            )

    def _wire_s(self, request: _Request) -> float:
        return scan_bytes(request.command, request.n_values) * _BITS_PER_BYTE / self.baud_rate

    @staticmethod
    def _period_s(request: _Request, parameters: Parameters) -> float:
        return parameters.period_s * (request.interval + 1)


def _one_echo(told: EchoScan, which: str) -> Scan:
    """The scan with one distance a step: the first, the last or the strongest of its echoes."""
    column = np.zeros(len(told.distances), dtype=np.int64)
    if which == "last":
        column = np.maximum((told.distances != NONE).sum(axis=1) - 1, 0)
    elif which == "strongest":
        column = np.argmax(told.intensities, axis=1)
    values = told.distances[np.arange(len(column)), column]
    return Scan(told.timestamp, np.where(told.damaged, 0, values), told.damaged, told.damaged_bytes)


def _is_reply_to(command: str) -> Callable[[Any], bool]:
    return lambda item: isinstance(item, Reply) and item.echo == command


def _parameters(fields: dict[str, str]) -> Parameters:
    """The parameters in an answer to PP; raises ScannerRefused when they cannot be a lidar's."""
    try:
        numbers = [int(fields[key]) for key in ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")]
    except (KeyError, ValueError) as error:
        raise ScannerRefused(f"the lidar's parameters (PP) cannot be read: {error}") from error
    low, high, turn, first, last, front, rpm = numbers
    if not (
        0 < low < high < 1 << 18 and 0 <= first <= front <= last <= 9999 and last - first < turn and 0 < rpm < 60_000
    ):
        raise ScannerRefused(f"the lidar's parameters (PP) contradict each other: {fields}")
    return Parameters(fields.get("MODL", "Hokuyo lidar"), low, high, turn, first, last, front, rpm)


def _meaning(status: str) -> str:
    """What a status of a measuring command says."""
    number = int(status) if status.isdigit() else -1
    if status in ("0D", "0E"):
        return f"it does not know this request (status {status}); ME, ND and NE are for newer models, use MD or MS"
    if 1 <= number <= 7:
        return f"a value of the request is wrong (status {status})"
    if number == 10:
        return "its laser is off (status 10)"
    if 21 <= number <= 49:
        return f"it stopped for a moment to check an error (status {status})"
    if 50 <= number <= 97:
        return f"it has a hardware fault (status {status}); switch it off and on"
    if number == 98:
        return "it goes on after an error (status 98)"
    return f"status {status}"
