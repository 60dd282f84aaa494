"""The device's half of GRBL 1.1: three axes behind a planner of 15 blocks and a buffer of 128 characters.

Bytes in, bytes out, the time is passed in. Lengths are millimetres; machine positions lie below zero, homing at the
upper ends, as the firmware has it by default.
"""

import math
import re
from collections import deque

from simulators.devices.motion import Axes, Vector

RX_BYTES = 128
LINE_CHARACTERS = 80
BLOCKS = 15
_HOMING_S = 0.3
_PULL_OFF_MM = 1.0
_FIRST_SETTINGS = {
    0: 10, 1: 25, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0, 10: 1, 11: 0.01, 12: 0.002, 13: 0, 20: 0, 21: 0, 22: 1, 23: 0,
    24: 25, 25: 500, 26: 250, 27: _PULL_OFF_MM, 30: 1000, 31: 0, 32: 0, 100: 250, 101: 250, 102: 250,
    110: 6000, 111: 6000, 112: 6000, 120: 500, 121: 500, 122: 500, 130: 300, 131: 300, 132: 300,
}  # fmt: skip
_WORD = re.compile(r"([A-Z])([+-]?(?:\d+\.?\d*|\.\d+))")
_REPORTED_WCO = 10


class GrblDevice:
    """A controller with its axes.

    `settings` replaces some of the `$` settings. `homed` starts it as if it had homed (it then is Idle, at zero).
    """

    def __init__(self, settings: dict[int, float] | None = None, *, homed: bool = False) -> None:
        self.settings: dict[int, float] = _FIRST_SETTINGS | (settings or {})
        self.axes = Axes(3, self.settings[120])
        self.is_mute = False
        self.position_wrong_by: Vector = (0.0, 0.0, 0.0)
        self.lines_taken = 0
        self.lost_characters = 0
        self._out = bytearray()
        self._rx = bytearray()
        self._lines: deque[str] = deque()
        self._after_return = False
        self._boot(alarm=bool(self.settings[22]) and not homed)

    # ---- what a test may do -----------------------------------------------------------------------------------------

    def reboot(self, now_s: float) -> None:
        """Lose power for an instant: axes stand, counts begin at zero again."""
        self.axes.halt(now_s)
        self.axes.put((0.0, 0.0, 0.0))
        self._boot(alarm=bool(self.settings[22]))

    def hit_limit(self, now_s: float) -> None:
        """A limit switch is hit: everything stands at once."""
        self.axes.halt(now_s)
        self._alarm(1)

    @property
    def state(self) -> str:
        """As status reports name it, without substate."""
        return self._state

    # ---- the device's half ------------------------------------------------------------------------------------------

    def receive(self, data: bytes, now_s: float) -> None:
        """Take in what the host sent: real-time bytes at once, the rest into a buffer that can overflow."""
        self._run(now_s)
        for byte in data:
            if self._realtime(byte, now_s):
                continue
            # The line that waits for the planner has left the buffer already.
            if len(self._rx) + sum(len(line) + 1 for line in list(self._lines)[1:]) >= RX_BYTES:
                self.lost_characters += 1  # a full buffer loses them, as the firmware's does
                continue
            after_return, self._after_return = self._after_return, byte == 0x0D
            if byte == 0x0A and after_return:
                continue  # the second half of one line end
            if byte in b"\r\n":
                self._lines.append(self._rx.decode("ascii", "replace").strip())
                self._rx.clear()
            else:
                self._rx.append(byte)
        self._run(now_s)

    def transmit(self, now_s: float, room_bytes: int) -> bytes:
        """At most `room_bytes` of what the device has to send by now."""
        self._run(now_s)
        sent = bytes(self._out[:room_bytes])
        del self._out[:room_bytes]
        return sent

    def next_due_s(self, now_s: float) -> float | None:
        """It answers, and lines may wait for the planner."""
        self._run(now_s)
        if self._out:
            return now_s
        return now_s + 0.005 if self._lines or self._homing_end_s is not None or self._dwell_s > now_s else None

    # ---- inside -----------------------------------------------------------------------------------------------------

    def _boot(self, *, alarm: bool) -> None:
        self._state = "Alarm" if alarm else "Idle"
        self._rx.clear()
        self._lines.clear()
        self._offset = [0.0, 0.0, 0.0]
        self._inches, self._relative = False, False
        self._feed, self._motion = 0.0, 0
        self._check = False
        self._homing_end_s: float | None = None
        self._dwell_s = -math.inf
        self._reports = 0
        self._is_jog = False
        self._say("")
        self._say("Grbl 1.1h ['$' for help]")
        if alarm:
            self._say("[MSG:'$H'|'$X' to unlock]")

    def _say(self, line: str) -> None:
        self._out += line.encode("ascii") + b"\r\n"

    def _alarm(self, code: int) -> None:
        self._state = "Alarm"
        self._homing_end_s = None
        self._say(f"ALARM:{code}")

    def _realtime(self, byte: int, now_s: float) -> bool:
        match byte:
            case 0x3F:
                if self._homing_end_s is None and not self.is_mute:
                    self._report(now_s)
            case 0x21:
                if self.axes.is_moving(now_s):
                    self._brake(now_s, keep=not self._is_jog)
                elif self._state == "Idle":
                    self._state = "Hold"
            case 0x7E:
                if self._state == "Hold":
                    self._state = "Idle"
                    self.axes.resume(now_s)
            case 0x18:
                self._soft_reset(now_s)
            case 0x85:
                if self._is_jog and self.axes.is_moving(now_s):
                    self._brake(now_s, keep=False)
                    self._lines.clear()
                    self._rx.clear()
            case _:
                return byte >= 0x80  # overrides and the like: taken, and without effect here
        return True

    def _brake(self, now_s: float, *, keep: bool) -> None:
        self.axes.brake(now_s, keep=keep)
        self._state = "Hold" if keep else self._state

    def _soft_reset(self, now_s: float) -> None:
        was_moving = self.axes.is_moving(now_s) or self._homing_end_s is not None
        was_homing = self._homing_end_s is not None
        locked = self._state == "Alarm"
        self.axes.halt(now_s)
        if was_moving:
            self._say(f"ALARM:{6 if was_homing else 3}")
        self._boot(alarm=was_moving or locked)

    def _run(self, now_s: float) -> None:
        """Do what has become possible by now."""
        if self._homing_end_s is not None:
            if now_s < self._homing_end_s:
                return
            self._homing_end_s = None
            self.axes.put((-_PULL_OFF_MM,) * 3)
            self._state = "Idle"
            self._say("ok")
        if self._is_jog and not self.axes.is_moving(now_s):
            self._is_jog = False
        while self._lines and now_s >= self._dwell_s and self._homing_end_s is None:
            if self.axes.blocks(now_s) >= BLOCKS and not self._lines[0].startswith("$"):
                return
            self._take(self._lines.popleft(), now_s)

    def _take(self, line: str, now_s: float) -> None:
        self.lines_taken += 1
        text = re.sub(r"\(.*?\)|\s", "", line.partition(";")[0]).upper()
        if len(line) > LINE_CHARACTERS:
            answer = "error:11"
        elif not text:
            answer = "ok"
        elif text.startswith("$"):
            answer = self._dollar(text, line.strip(), now_s)
        elif self._state == "Alarm":
            answer = "error:9"
        else:
            answer = self._gcode(text, now_s, jog=False)
        if answer:
            self._say(answer)

    def _dollar(self, text: str, line: str, now_s: float) -> str:
        is_free = self._state in ("Idle", "Alarm") and not self.axes.is_moving(now_s)
        if text.startswith("$J="):
            if self._state == "Alarm" or (self.axes.is_moving(now_s) and not self._is_jog) or self._state == "Hold":
                return "error:9" if self._state == "Alarm" else "error:8"
            return self._gcode(text[3:], now_s, jog=True)
        if not is_free and text not in ("$", "$G", "$C", "$X"):
            return "error:8"
        match text:
            case "$":
                self._say("[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]")
            case "$$":
                for number, value in self.settings.items():
                    self._say(f"${number}={value:g}" if number < 100 else f"${number}={value:.3f}")
            case "$#":
                for place in ("G54", "G55", "G56", "G57", "G58", "G59", "G28", "G30", "G92"):
                    self._say(f"[{place}:{_joined(self._offset if place == 'G54' else (0.0, 0.0, 0.0))}]")
                self._say("[TLO:0.000]")
                self._say("[PRB:0.000,0.000,0.000:0]")
            case "$G":
                modes = f"G{self._motion} G54 G17 G{20 if self._inches else 21} G{91 if self._relative else 90} G94"
                self._say(f"[GC:{modes} M5 M9 T0 F{self._feed:g} S0]")
            case "$I":
                self._say("[VER:1.1h.20190830:]")
                self._say("[OPT:V,15,128]")
            case "$N":
                self._say("$N0=")
                self._say("$N1=")
            case "$C":
                self._check = not self._check
                self._state = "Check" if self._check else "Idle"
                self._say(f"[MSG:{'Enabled' if self._check else 'Disabled'}]")
            case "$X":
                if self._state == "Alarm":
                    self._state = "Idle"
                    self._say("[MSG:Caution: Unlocked]")
            case "$H":
                if not self.settings[22]:
                    return "error:5"
                self._state = "Home"
                self._homing_end_s = now_s + _HOMING_S
                return ""
            case _:
                setting = re.fullmatch(r"\$(\d+)=(-?[\d.]+)", text)
                if setting is None or int(setting[1]) not in self.settings:
                    return "error:3"
                self.settings[int(setting[1])] = float(setting[2])
        return "ok"

    def _gcode(self, text: str, now_s: float, *, jog: bool) -> str:
        words = _WORD.findall(text)
        if "".join(letter + value for letter, value in words) != text:
            return "error:2" if text[0].isalpha() else "error:1"
        inches, relative = self._inches, self._relative
        machine, motion, dwell_s, zeroed = False, None if jog else self._motion, None, False
        axes: dict[int, float] = {}
        feed = self._feed if not jog else 0.0
        for letter, value in words:
            number = float(value)
            match letter, number:
                case ("G", 0 | 1) if not jog:
                    motion = int(number)
                case ("G", 4) if not jog:
                    dwell_s = 0.0
                case ("G", 20 | 21):
                    inches = number == 20
                case ("G", 53):
                    machine = True
                case ("G", 90 | 91):
                    relative = number == 91
                case ("G", 92) if not jog:
                    zeroed = True
                case ("G", 17 | 18 | 19 | 40 | 49 | 54 | 61 | 80 | 94) | ("M", 0 | 2 | 3 | 4 | 5 | 7 | 8 | 9 | 30) if (
                    not jog
                ):
                    pass
                case ("X" | "Y" | "Z", _):
                    axes["XYZ".index(letter)] = number
                case ("F", _):
                    feed = number
                case ("P", _) if dwell_s is not None:
                    dwell_s = number
                case ("S" | "T" | "N", _) if not jog:
                    pass
                case _:
                    return "error:20"
        scale = 25.4 if inches else 1.0
        if jog:
            if not axes:
                return "error:26"
            if not feed > 0:
                return "error:22"
            return self._start(axes, scale, feed * scale, machine, relative, now_s, jog=True)
        self._inches, self._relative, self._motion = inches, relative, motion or 0
        self._feed = feed
        if dwell_s is not None:
            end_s = now_s + dwell_s
            while self.axes.is_moving(end_s):
                end_s += 0.01
            self._dwell_s = end_s
            return "ok"
        if zeroed:
            here = self.axes.position(now_s)
            for index, value in axes.items():
                self._offset[index] = here[index] - value * scale
            return "ok"
        if not axes:
            return "ok"
        if motion == 1 and not feed > 0:
            return "error:22"
        speed_per_min = self.settings[110] if motion == 0 else feed * scale
        return self._start(axes, scale, speed_per_min, machine, relative, now_s, jog=False)

    def _start(
        self,
        axes: dict[int, float],
        scale: float,
        speed_per_min: float,
        machine: bool,
        relative: bool,
        now_s: float,
        *,
        jog: bool,
    ) -> str:
        if self._check:
            return "ok"
        target = list(self.axes.planned())
        for index, value in axes.items():
            base = target[index] if relative and not machine else 0.0 if machine else self._offset[index]
            target[index] = base + value * scale
        if self.settings[20] and any(
            not -self.settings[130 + index] <= place <= 0.0 for index, place in enumerate(target)
        ):
            if jog:
                return "error:15"
            self._alarm(2)
            return ""
        fastest = min(self.settings[110 + index] for index in axes)
        self._is_jog = jog
        self.axes.go(tuple(target), min(speed_per_min, fastest) / 60.0, now_s)
        return "ok"

    def _report(self, now_s: float) -> None:
        state, moving = self._state, self.axes.is_moving(now_s)
        if state == "Hold":
            state = "Hold:1" if moving else "Hold:0"
        elif state == "Idle" and moving:
            state = "Jog" if self._is_jog else "Run"
        elif state == "Idle" and now_s < self._dwell_s:
            state = "Run"
        scale = 1 / 25.4 if self.settings[13] else 1.0
        here = [
            (place + wrong) * scale
            for place, wrong in zip(self.axes.position(now_s), self.position_wrong_by, strict=True)
        ]
        offset = [value * scale for value in self._offset]
        told = f"MPos:{_joined(here)}"
        if not int(self.settings[10]) & 1:
            told = f"WPos:{_joined([place - zero for place, zero in zip(here, offset, strict=True)])}"
        fields = [state, told, f"FS:{self.axes.speed(now_s) * 60.0 * scale:.0f},0"]
        if self._reports % _REPORTED_WCO == 0:
            fields.append(f"WCO:{_joined(offset)}")
        elif self._reports % _REPORTED_WCO == 1:
            fields.append("Ov:100,100,100")
        self._reports += 1
        self._say(f"<{'|'.join(fields)}>")


def _joined(values: tuple[float, ...] | list[float]) -> str:
    return ",".join(f"{value:.3f}" for value in values)
