"""The host's half of SCIP 2.0: meet a Hokuyo lidar, choose rate and request, make profiles of its scans; no port.

What it asks for is only what the sensor announced (PP), because old firmware locks up on what it does not know.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from drivers.errors import ScannerRefused, ScannerSilent, ScannerTimeout
from drivers.protocols.conversation import Conversation, Listener
from drivers.protocols.device_clock import DeviceClock
from drivers.protocols.dialogue import Answer, Quiet, Script
from drivers.protocols.framing import Damage, DamageReason
from drivers.protocols.polar import reasons_of, sensor_from_polar
from drivers.protocols.scip import (
    CLOCK_SPAN,
    CLOCK_TICK_S,
    SCANNING,
    STREAMS,
    Reply,
    ReplyDecoder,
    Scan,
    info_fields,
    scan_of,
    stream_echo,
)
from drivers.protocols.scip_echoes import ECHO_STREAMS, NONE, EchoScan, echoes_of
from drivers.protocols.scip_plan import RATES, Parameters, Request, ScipOptions, parameters_of, request_for
from drivers.scanline import DeviceInfo, SensorGeometry

QUIET_S = 0.14
"""Silence after which a stale stream is taken to have ended; Hokuyo's own client waits as long."""
_ANSWER_S = 0.4
_STALE_S = 2.5  # a scan that was under way at 19200 baud takes more than a second to arrive
_CODES = 32  # no model has more codes; a nearest distance beyond them must not make more reasons
_WIDTHS = STREAMS | ECHO_STREAMS


class ScipHost(Conversation):
    """One conversation with one Hokuyo lidar."""

    def __init__(self, listener: Listener, rates: tuple[int, ...] = RATES, options: ScipOptions | None = None) -> None:
        super().__init__(listener, ReplyDecoder(), rates)
        self._options = options or ScipOptions()
        self._parameters: Parameters | None = None
        self._request: Request | None = None
        self._angles_rad = np.empty(0)
        self._clock = DeviceClock(CLOCK_SPAN, CLOCK_TICK_S)
        self._dropped_lines = 0  # scans that the lidar made and had no time to send

    # ---- scripts --------------------------------------------------------------------------------------------------

    def _greet(self) -> Script[DeviceInfo]:
        yield from self._find_rate(self._quieten)
        version = yield from self._information("VV")
        parameters = parameters_of((yield from self._information("PP")))
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
            points_per_line=request_for(self._options, parameters, self.baud_rate).n_values,
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
        request = request_for(self._options, self._parameters, self.baud_rate)
        self._check_bandwidth(request, self._parameters)
        self._request = request
        self._angles_rad = request.angles_rad(self._parameters)
        self.silent_after_s = max(2.0, 5 * request.period_s(self._parameters))
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
        self._dropped_lines += self._account.lost_by_time(device_time_s, request.period_s(parameters))
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

    def _read(self, answer: Reply, request: Request) -> Scan | None:
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

    def _check_bandwidth(self, request: Request, parameters: Parameters) -> None:
        wire_s, period_s = request.wire_s(self.baud_rate), request.period_s(parameters)
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
