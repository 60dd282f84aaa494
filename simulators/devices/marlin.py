"""The device's half of Marlin: axes, numbered lines with checksums, M114 with step counts, M400, M410; no hotend.

Bytes in, bytes out, the time is passed in. One command is carried out after the other; M114 tells the planned position
and, behind `Count`, where the steppers are.
"""

import re
from collections import deque
from functools import reduce

from simulators.devices.motion import Axes

BLOCKS = 16
_KEEPALIVE_S = 2.0
_HOMING_S = 0.3
_WORD = re.compile(r"([A-Z])([+-]?(?:\d+\.?\d*|\.\d+)?)")


class MarlinDevice:
    """A controller with X, Y and Z.

    `emergency_parser` makes M410 act at once, whatever it is busy with. `answers_m92` is False for firmwares that stay
    silent when asked for their steps.
    """

    def __init__(
        self,
        steps_per_mm: float = 80.0,
        *,
        emergency_parser: bool = True,
        answers_m92: bool = True,
        acceleration: float = 500.0,
        speed_mm_per_s: float = 200.0,
    ) -> None:
        self.steps_per_mm = steps_per_mm
        self.axes = Axes(3, acceleration)
        self.is_mute = False
        self.swallow_oks = 0
        self.homed = False
        self.resends = 0
        self._emergency_parser = emergency_parser
        self._answers_m92 = answers_m92
        self._fastest = speed_mm_per_s
        self._out = bytearray()
        self._boot()

    def reboot(self, now_s: float) -> None:
        """Lose power for an instant."""
        self.axes.halt(now_s)
        self.axes.put((0.0, 0.0, 0.0))
        self.homed = False
        self._boot()

    def kill(self, now_s: float) -> None:
        """Halt for good, as after M112 or a thermal fault."""
        self.axes.halt(now_s)
        self._say("Error:Printer halted. kill() called!")
        self._is_halted = True

    def receive(self, data: bytes, now_s: float) -> None:
        """Take in what the host sent."""
        self._run(now_s)
        if self._is_halted:
            return
        for byte in data:
            if byte not in b"\r\n":
                self._open.append(byte)
                continue
            line = self._open.decode("ascii", "replace").strip()
            self._open.clear()
            if line:
                if self._emergency_parser and "M410" in line:
                    self._quick_stop(now_s)
                self._lines.append(line)
        self._run(now_s)

    def transmit(self, now_s: float, room_bytes: int) -> bytes:
        """At most `room_bytes` of what the device has to send by now."""
        self._run(now_s)
        sent = bytes(self._out[:room_bytes])
        del self._out[:room_bytes]
        return sent

    def next_due_s(self, now_s: float) -> float | None:
        """It answers, and lines may wait."""
        self._run(now_s)
        return now_s if self._out else now_s + 0.005 if self._lines or self._busy is not None else None

    # ---- inside -----------------------------------------------------------------------------------------------------

    def _boot(self) -> None:
        self._open = bytearray()
        self._lines: deque[str] = deque()
        self._last_number = 0
        self._relative = False
        self._feed_per_min = 1500.0
        self._busy: str | None = None  # M400, or G28 until a time
        self._until_s = 0.0
        self._keepalive_s = 0.0
        self._is_halted = False
        self._say("start")
        self._say("echo:Marlin 2.1.2")

    def _say(self, line: str) -> None:
        if not self.is_mute:
            self._out += line.encode("ascii", "replace") + b"\n"

    def _ok(self, more: str = "") -> None:
        if self.swallow_oks:
            self.swallow_oks -= 1
        else:
            self._say("ok" + more)

    def _quick_stop(self, now_s: float) -> None:
        self.axes.halt(now_s)
        if self._busy == "G28":
            self._busy, self.homed = None, False
            self._ok()

    def _run(self, now_s: float) -> None:
        while not self._is_halted:
            if self._busy is not None:
                if not self._is_over(now_s):
                    if now_s >= self._keepalive_s:
                        self._say("echo:busy: processing")
                        self._keepalive_s = now_s + _KEEPALIVE_S
                    return
                if self._busy == "G28":
                    self.axes.put((0.0, 0.0, 0.0))
                    self.homed = True
                self._busy = None
                self._ok()
            if not self._lines or self.axes.blocks(now_s) >= BLOCKS:
                return
            self._take(self._lines.popleft(), now_s)

    def _is_over(self, now_s: float) -> bool:
        return now_s >= self._until_s if self._busy == "G28" else not self.axes.is_moving(now_s)

    def _take(self, line: str, now_s: float) -> None:
        numbered = re.fullmatch(r"N(-?\d+) ?(.*?)\*(\d+)", line)
        if line.startswith("N") and numbered is None:
            self._want_again("No Checksum with line number")
            return
        if numbered is not None:
            body = line.rpartition("*")[0]
            number, command = int(numbered[1]), numbered[2].strip()
            if reduce(lambda total, byte: total ^ byte, body.encode("ascii", "replace"), 0) != int(numbered[3]):
                self._want_again("checksum mismatch")
                return
            if number != self._last_number + 1 and not command.startswith("M110"):
                self._want_again("Line Number is not Last Line Number+1")
                return
            self._last_number = number
        else:
            command = line
        self._carry_out(command, now_s)

    def _want_again(self, why: str) -> None:
        self.resends += 1
        self._say(f"Error:{why}, Last Line: {self._last_number}")
        self._lines.clear()
        self._say(f"Resend: {self._last_number + 1}")
        self._ok()

    def _carry_out(self, command: str, now_s: float) -> None:
        code, _, rest = command.partition(" ")
        words: dict[str, str] = dict(_WORD.findall(rest.replace(" ", "")))
        match code.upper():
            case "G0" | "G1":
                self._move(words, now_s)
            case "G90" | "G91":
                self._relative = code.upper() == "G91"
            case "G28":
                self._busy, self._until_s = "G28", now_s + _HOMING_S
                self._keepalive_s = now_s + _KEEPALIVE_S
                return
            case "M400":
                self._busy, self._keepalive_s = "M400", now_s + _KEEPALIVE_S
                return
            case "M410":
                self.axes.halt(now_s)
            case "M112":
                self.kill(now_s)
                return
            case "M110":
                self._last_number = int(words["N"]) if words.get("N") else self._last_number
            case "M105":
                self._ok(" T:21.30 /0.00 B:21.10 /0.00 @:0 B@:0")
                return
            case "M114":
                self._locate(now_s)
            case "M92":
                if self._answers_m92:
                    self._say("echo: M92 " + " ".join(f"{letter}{self.steps_per_mm:.2f}" for letter in "XYZE"))
            case "M115":
                self._say(
                    "FIRMWARE_NAME:Marlin 2.1.2 (simulated) SOURCE_CODE_URL:github.com/MarlinFirmware/Marlin "
                    "PROTOCOL_VERSION:1.0 MACHINE_TYPE:Stage EXTRUDER_COUNT:1"
                )
                self._say(f"Cap:EMERGENCY_PARSER:{int(self._emergency_parser)}")
                self._say("Cap:AUTOREPORT_POS:0")
            case (
                "G20" | "G21" | "M82" | "M83" | "M84" | "M17" | "M18" | "G92" | "M113" | "T0" | "M104" | "M140" | "M117"
            ):
                pass
            case _:
                self._say(f'echo:Unknown command: "{command}"')
        self._ok()

    def _move(self, words: dict[str, str], now_s: float) -> None:
        if words.get("F"):
            self._feed_per_min = float(words["F"])
        target = list(self.axes.planned())
        for index, letter in enumerate("XYZ"):
            if words.get(letter):
                target[index] = float(words[letter]) + (target[index] if self._relative else 0.0)
        self.axes.go(tuple(target), min(self._feed_per_min / 60.0, self._fastest), now_s)

    def _locate(self, now_s: float) -> None:
        planned = self.axes.planned()
        counts = [round(place * self.steps_per_mm) for place in self.axes.position(now_s)]
        places = " ".join(f"{letter}:{value:.2f}" for letter, value in zip("XYZE", (*planned, 0.0), strict=True))
        self._say(f"{places} Count X:{counts[0]} Y:{counts[1]} Z:{counts[2]}")
