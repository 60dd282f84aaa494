"""A Hokuyo lidar's half of SCIP 2.0: requests in, replies and scans out, time passed in; knows no pty and no optics.

It has a sensor's manners: scans that the line has no time for are not sent, a rate asked for holds after the reply, and
`DB` makes it misbehave on demand.
"""

import re
from collections import deque
from dataclasses import dataclass

import numpy as np

from drivers.protocols.scip import (
    CLOCK_SPAN,
    SCANNING,
    STREAMS,
    checked,
    data_lines,
    encode_value,
    info_lines,
    reply,
)
from drivers.protocols.scip_echoes import ECHO_STREAMS
from simulators.devices.scip_scans import URG_04LX, Model, scan_characters
from simulators.sweep import RangeScene

_RATES = (19_200, 38_400, 57_600, 115_200, 250_000, 500_000, 750_000)
_MAX_REQUEST = 64
_MEASURE = re.compile(r"(M[DSE]|N[DE]|G[DSE]|H[DE])(\d{4})(\d{4})(\d{2})(?:(\d)(\d{2}))?")
_TAG = re.compile(r"[A-Za-z0-9 ._+@]{0,16}")


@dataclass(frozen=True, slots=True)
class Quirks:
    """Faults that real firmware has: a wrong sum in VV, waking up in SCIP 1.1, refusing every change of rate."""

    bad_version_sum: bool = False
    starts_in_scip1: bool = False
    refuses_rates: bool = False


@dataclass(slots=True)
class _Stream:
    """A measurement under way: `remaining` None has no end; scan k is due at `next_s`."""

    echo: str
    command: str
    start: int
    end: int
    cluster: int
    interval: int
    remaining: int | None
    next_s: float


class ScipDevice:
    """One lidar.

    Parameters
    ----------
    scene : what it sees.
    model : its type.
    serial : its serial number.
    baud_rate : the rate it wakes up at; the port follows `baud_rate` when SS changes it.
    clock_ms : what its 24-bit clock shows when it is switched on.
    behind : what it sees through the scene, as further echoes, where its model tells them.
    """

    def __init__(
        self,
        scene: RangeScene,
        model: Model = URG_04LX,
        *,
        serial: str = "H0000001",
        baud_rate: int = 19_200,
        clock_ms: int = 0,
        quirks: Quirks | None = None,
        behind: RangeScene | None = None,
    ) -> None:
        self.baud_rate = baud_rate
        self.model = model
        self.laser_on = False
        self.scans_made = 0
        """Scans that were due in a measurement; those not sent for want of time on the line are among them."""
        self.scans_sent = 0
        self._scene = scene
        self._behind = behind
        self._serial = serial
        self._power_on_rate = baud_rate
        self._clock_ms = clock_ms
        self._clock_from_s: float | None = None
        self._quirks = quirks or Quirks()
        self._is_scip1 = self._quirks.starts_in_scip1
        self._request = bytearray()
        self._out = bytearray()
        self._replies: deque[tuple[bytes, int | None]] = deque()
        self._rate_after: int | None = None
        self._stream: _Stream | None = None
        self._measuring_since_s: float | None = None
        self._time_mode = False
        self._malfunction = 0
        self._streamed = 0

    # ---- the port -------------------------------------------------------------------------------------------------

    def receive(self, data: bytes, now_s: float) -> None:
        """Take bytes from the host; a request ends with LF or CR."""
        self._start_clock(now_s)
        for byte in data:
            if byte not in b"\r\n":
                if len(self._request) < _MAX_REQUEST:
                    self._request.append(byte)
                continue
            request = self._request.decode("ascii", "replace")
            self._request.clear()
            if request:
                self._obey(request, now_s)

    def transmit(self, now_s: float, room_bytes: int) -> bytes:
        """At most `room_bytes` of what there is to send by now.

        What the line had time for since the last call was sent meanwhile: a scan finds the line as that leaves it.
        """
        self._start_clock(now_s)
        sent = self._send(room_bytes)
        self._measure(now_s)
        return sent + self._send(room_bytes - len(sent))

    def _send(self, room_bytes: int) -> bytes:
        while len(self._out) < room_bytes and self._rate_after is None and self._replies:
            answer, rate = self._replies.popleft()
            self._out += answer
            self._rate_after = rate
        sent = bytes(self._out[:room_bytes])
        del self._out[:room_bytes]
        if not self._out and self._rate_after is not None:
            self.baud_rate, self._rate_after = self._rate_after, None
        return sent

    def next_due_s(self, now_s: float) -> float | None:
        """When there is next something to send."""
        if self._out or self._replies:
            return now_s
        return None if self._stream is None else max(now_s, self._stream.next_s)

    def power_cycle(self) -> None:
        """Switch off and on: laser off, first rate, clock at zero."""
        self._stream = None
        self.laser_on = self._time_mode = False
        self._replies.clear()
        self._out.clear()
        self._request.clear()
        self._rate_after = None
        self.baud_rate = self._power_on_rate
        self._clock_ms, self._clock_from_s = 0, None
        self._is_scip1 = self._quirks.starts_in_scip1

    # ---- requests -------------------------------------------------------------------------------------------------

    def _answer(self, echo: str, status: str, lines: bytes = b"", rate: int | None = None) -> None:
        self._replies.append((reply(echo, status, lines), rate))

    def _obey(self, request: str, now_s: float) -> None:
        command, _, tag = request.partition(";")
        if self._is_scip1:
            if command == "SCIP2.0":
                self._is_scip1 = False
                self._replies.append((request.encode("ascii", "replace") + b"\n0\n\n", None))
            else:
                self._replies.append((request.encode("ascii", "replace") + b"\nE\n\n", None))
            return
        if not request.isascii() or not request.isprintable():
            self._answer("?", "0E")
            return
        if not _TAG.fullmatch(tag):
            self._answer(request, "0G" if len(tag) > 16 else "0H")
            return
        if self._time_mode and not command.startswith("TM"):
            self._answer(request, "0E")
            return
        match command[:2], command[2:]:
            case "VV", "":
                self._answer(request, "00", self._version())
            case "PP", "":
                self._answer(request, "00", self._parameters())
            case "II", "":
                self._answer(request, "00", self._state(now_s))
            case "BM", "":
                self._answer(request, "01" if self._malfunction in (1, 2) else "02" if self.laser_on else "00")
                self._switch_laser(self._malfunction not in (1, 2))
            case "QT", "":
                self._stream = None
                self._switch_laser(False)
                self._answer(request, "00")
            case "RS", "":
                self._stream = None
                self._switch_laser(False)
                self._malfunction = 0
                self._clock_ms, self._clock_from_s = 0, now_s
                self._answer(request, "00", rate=self._power_on_rate)
            case "SC", "IP2.0":
                self._answer(request, "00")
            case "SS", rate:
                self._set_rate(request, rate)
            case "TM", mode:
                self._time(request, mode, now_s)
            case "DB", number if number.isdigit() and len(number) == 2:
                self._malfunction = 0 if number == "10" else int(number)
                self._answer(request, "00" if number in ("01", "02", "03", "04", "05", "10") else "01")
            case "MD" | "MS" | "ME" | "GD" | "GS" | "GE", _:
                self._start(request, command, now_s)
            case "ND" | "NE" | "HD" | "HE", _ if self.model.tells_echoes:
                self._start(request, command, now_s)
            case _:
                self._answer(request, "0E")

    def _version(self) -> bytes:
        lines = info_lines(
            {
                "VEND": "Hokuyo Automatic Co.,Ltd.",
                "PROD": "SOKUIKI Sensor " + self.model.name.partition("(")[0],
                "FIRM": "3.3.00(simulated)",
                "PROT": "SCIP 2.0",
                "SERI": self._serial,
            }
        )
        return lines[:-2] + b"?\n" if self._quirks.bad_version_sum else lines

    def _parameters(self) -> bytes:
        model = self.model
        values = (model.min_mm, model.max_mm, model.steps_per_turn, model.first, model.last, model.front, model.rpm)
        keys = ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")
        return info_lines({"MODL": model.name} | {key: str(value) for key, value in zip(keys, values, strict=True)})

    def _state(self, now_s: float) -> bytes:
        return info_lines(
            {
                "MODL": self.model.name,
                "LASR": "ON" if self.laser_on else "OFF",
                "SCSP": f"Initial({self.model.rpm}[rpm])<-Default setting by user",
                "MESM": "IDLE" if self._stream is None else "Measuring by Sensitive Mode",
                "SBPS": f"{self.baud_rate}[bps]<-Default setting by user",
                "TIME": f"{self._clock(now_s):06X}",
                "STAT": "Sensor works well.",
            }
        )

    def _set_rate(self, request: str, text: str) -> None:
        if not (text.isdigit() and len(text) == 6):
            self._answer(request, "01")
        elif int(text) not in _RATES:
            self._answer(request, "02")
        elif int(text) == self.baud_rate:
            self._answer(request, "03")
        elif self._quirks.refuses_rates:
            self._answer(request, "04")
        else:
            self._answer(request, "00", rate=int(text))

    def _time(self, request: str, mode: str, now_s: float) -> None:
        match mode:
            case "0":
                self._answer(request, "02" if self._time_mode else "00")
                self._time_mode = True
                self._stream = None
                self._switch_laser(False)
            case "1" if self._time_mode:
                self._answer(request, "00", checked(encode_value(self._clock(now_s), 4)))
            case "1":
                self._answer(request, "04")
            case "2":
                self._answer(request, "00" if self._time_mode else "03")
                self._time_mode = False
            case _:
                self._answer(request, "01")

    def _start(self, request: str, command: str, now_s: float) -> None:
        match = _MEASURE.fullmatch(command)
        is_stream = command[:2] in STREAMS | ECHO_STREAMS
        if match is None or (match[5] is None) == is_stream:
            self._answer(request, "0C" if len(command) < 12 else "01")
            return
        start, end, cluster = int(match[2]), int(match[3]), max(1, int(match[4]))
        if end > self.model.last:
            self._answer(request, "04")
        elif end < start or start < self.model.first:
            self._answer(request, "05")
        elif self._malfunction in (1, 2):
            self._answer(request, "50")
        elif not is_stream:
            if not self.laser_on:
                self._answer(request, "10")
                return
            self._answer(request, "00", self._scan(command[:2], start, end, cluster, now_s))
        else:
            count = int(match[6])
            self._answer(request, "00")
            self._switch_laser(True)
            self._streamed = 0
            self._measuring_since_s = None
            self._stream = _Stream(
                request, command[:2], start, end, cluster, int(match[5]), count or None, now_s + 60.0 / self.model.rpm
            )

    # ---- measuring ------------------------------------------------------------------------------------------------

    def _measure(self, now_s: float) -> None:
        stream = self._stream
        while stream is not None and stream.next_s <= now_s:
            at_s = stream.next_s
            stream.next_s += 60.0 / self.model.rpm * (stream.interval + 1)
            self.scans_made += 1
            if self._out or self._replies:  # the line is still busy with the last one
                continue
            if self._streamed >= 20 and self._malfunction in (3, 4, 5):
                self._misbehave(stream)
                stream = self._stream
                continue
            if stream.remaining is not None:
                stream.remaining -= 1
            echo, _, tag = stream.echo.partition(";")
            echo = f"{echo[:13]}{stream.remaining or 0:02d}" + (f";{tag}" if tag else "")
            lines = self._scan(stream.command, stream.start, stream.end, stream.cluster, at_s)
            self._answer(echo, SCANNING, lines)
            self.scans_sent += 1
            self._streamed += 1
            if stream.remaining == 0:
                self._stream = stream = None
                self._switch_laser(False)

    def _misbehave(self, stream: _Stream) -> None:
        """DB03 stops for a moment and goes on, DB04 sends a scan whose sums are wrong, DB05 stops for good."""
        malfunction, self._malfunction = self._malfunction, 0
        if malfunction == 3:
            self._answer(stream.echo, "21")
            self._answer(stream.echo, "98")
        elif malfunction == 4:
            self._answer(stream.echo, SCANNING, b"0000?\n" + b"0" * 64 + b"?\n")
        else:
            self._answer(stream.echo, "50")
            self._stream = None
            self._switch_laser(False)

    def _scan(self, command: str, start: int, end: int, cluster: int, at_s: float) -> bytes:
        if self._measuring_since_s is None:
            self._measuring_since_s = at_s
        angles, elapsed_s = self.model.angles_rad(start, end), at_s - self._measuring_since_s
        behind = np.full(len(angles), np.nan) if self._behind is None else self._behind(angles, elapsed_s)
        ranges = self._scene(angles, elapsed_s)
        return data_lines(self._clock(at_s), scan_characters(self.model, command, cluster, ranges, behind))

    def _switch_laser(self, on: bool) -> None:
        if on and not self.laser_on:
            self._measuring_since_s = None
        self.laser_on = on

    def _start_clock(self, now_s: float) -> None:
        if self._clock_from_s is None:
            self._clock_from_s = now_s

    def _clock(self, at_s: float) -> int:
        """The 24-bit clock in ms."""
        return (self._clock_ms + round((at_s - (self._clock_from_s or at_s)) * 1e3)) % CLOCK_SPAN
