"""The device's half of Zaber's ASCII protocol: one device with one axis in microsteps; knows no millimetres.

Bytes in, bytes out, the time is passed in. A checksum and a message id are given back when they were sent.
"""

import re

from simulators.devices.motion import Axes

SPEED_SCALE = 1.6384
_COMMAND = re.compile(r"/(?:(\d{1,2})(?: (\d)(?: (\d\d))?)?)? ?(.*)")


class ZaberDevice:
    """A device at address `device` of a chain; its axis travels from 0 to `limit_max` microsteps."""

    def __init__(
        self, device: int = 1, limit_max: int = 305_381, *, has_reference: bool = False, serial: int = 12345
    ) -> None:
        self.device = device
        self.axes = Axes(1, 200_000.0)
        self.is_mute = False
        self.damaged_lines = 0
        self.flags: list[str] = [] if has_reference else ["WR"]
        self.settings: dict[str, str] = {
            "deviceid": "50081", "device.id": "50081", "version": "7.34", "version.build": "16000",
            "system.serial": str(serial), "system.axiscount": "1", "system.access": "1", "comm.alert": "0",
            "comm.checksum": "0", "comm.protocol": "2", "comm.rs232.baud": "115200", "comm.address": str(device),
            "comm.next.owner": "0", "peripheralid": "0", "peripheral.id": "0", "resolution": "64",
            "limit.min": "0", "limit.max": str(limit_max), "maxspeed": "153600", "accel": "205",
            "lockstep.numgroups": "0",
            "system.platform": "0", "device.hw.modified": "0", "peripheral.hw.modified": "0", "peripheral.serial": "0",
        }  # fmt: skip
        self._homing = False
        self._open = bytearray()
        self._out = bytearray()

    def reboot(self, now_s: float) -> None:
        """Lose power for an instant: the reference is gone."""
        self.axes.halt(now_s)
        self.axes.put((0.0,))
        self.flags = ["WR"]
        self._homing = False

    def stall(self, now_s: float) -> None:
        """Meet an obstacle: stand at once, somewhere."""
        self.axes.halt(now_s)
        self._homing = False
        self.flags = ["FS", *self.flags]

    def receive(self, data: bytes, now_s: float) -> None:
        """Take in what the host sent."""
        for byte in data:
            if byte == 0x2F:
                self._open.clear()  # a slash always begins a command
            if byte in b"\r\n":
                line = self._open.decode("ascii", "replace")
                self._open.clear()
                if line.startswith("/"):
                    self._take(line, now_s)
            elif len(self._open) < 128:
                self._open.append(byte)

    def transmit(self, now_s: float, room_bytes: int) -> bytes:
        """At most `room_bytes` of what the device has to send by now."""
        self._settle(now_s)
        sent = bytes(self._out[:room_bytes])
        del self._out[:room_bytes]
        return sent

    def next_due_s(self, now_s: float) -> float | None:
        """It speaks when spoken to."""
        self._settle(now_s)
        return now_s if self._out else None

    # ---- inside -----------------------------------------------------------------------------------------------------

    def _settle(self, now_s: float) -> None:
        if self._homing and not self.axes.is_moving(now_s):
            self._homing = False
            self.axes.put((0.0,))
            self.flags = [flag for flag in self.flags if flag not in ("WR", "WH", "FS")]

    def _take(self, line: str, now_s: float) -> None:
        self._settle(now_s)
        body, colon, sum_text = line.rpartition(":")
        checked = bool(colon) and re.fullmatch(r"[0-9A-Fa-f]{2}", sum_text) is not None
        if checked:
            if -sum(body[1:].encode("ascii", "replace")) & 0xFF != int(sum_text, 16):
                self.damaged_lines += 1
                return
            line = body
        match = _COMMAND.fullmatch(line)
        if match is None:
            return
        device, axis, number, words = int(match[1] or 0), int(match[2] or 0), match[3], match[4].strip()
        if device not in (0, self.device):
            return
        if axis > 1:
            verdict, data = "RJ", "BADAXIS"
        else:
            verdict, data = self._carry_out(words.split(), axis, now_s)
        state = "BUSY" if self.axes.is_moving(now_s) else "IDLE"
        flag = self.flags[0] if self.flags else "--"
        id_text = f" {number}" if number is not None else ""
        text = f"{self.device:02d} {axis}{id_text} {verdict} {state} {flag} {data}"
        end = f":{-sum(text.encode('ascii')) & 0xFF:02X}" if checked else ""
        if not self.is_mute:
            self._out += f"@{text}{end}\r\n".encode("ascii")

    def _carry_out(self, words: list[str], axis: int, now_s: float) -> tuple[str, str]:
        match words:
            case []:
                return "OK", "0"
            case ["get", "pos" | "encoder.pos"]:
                return "OK", str(round(self.axes.position(now_s)[0]))
            case ["get", name] if name in self.settings:
                return "OK", self.settings[name]
            case ["set", name, value] if name in self.settings:
                if not re.fullmatch(r"-?\d+(\.\d+)?", value):
                    return "RJ", "BADDATA"
                self.settings[name] = value
                return "OK", "0"
            case ["warnings"]:
                return "OK", " ".join([f"{len(self.flags):02d}", *self.flags])
            case ["warnings", "clear"]:
                told = " ".join([f"{len(self.flags):02d}", *self.flags])
                self.flags = [flag for flag in self.flags if flag == "WR"]
                return "OK", told
            case ["home"]:
                self.axes.halt(now_s)
                self._homing = True
                self.axes.go((0.0,), self._speed(), now_s)
                self._settle(now_s)
                return "OK", "0"
            case ["stop"]:
                self.axes.brake(now_s)
                self._homing = False
                return "OK", "0"
            case ["estop"]:
                self.axes.halt(now_s)
                self._homing = False
                return "OK", "0"
            case ["move", kind, *more]:
                return self._move(kind, more, now_s)
            case ["system", "reset"]:
                self.reboot(now_s)
                return "OK", "0"
        return "RJ", "BADCOMMAND"

    def _move(self, kind: str, more: list[str], now_s: float) -> tuple[str, str]:
        here = self.axes.position(now_s)[0]
        low, high = int(self.settings["limit.min"]), int(self.settings["limit.max"])
        match kind, more:
            case ("min", _):
                target = low
            case ("max", _):
                target = high
            case ("abs", [value, *_]) if re.fullmatch(r"-?\d+", value):
                target = int(value)
            case ("rel", [value, *_]) if re.fullmatch(r"-?\d+", value):
                target = round(here) + int(value)
            case _:
                return "RJ", "BADDATA"
        if not low <= target <= high:
            return "RJ", "BADDATA"
        if "WR" in self.flags and kind in ("abs", "max"):
            return "RJ", "BADCOMMAND"
        self.axes.halt(now_s)
        self.axes.go((float(target),), self._speed(), now_s)
        return "OK", "0"

    def _speed(self) -> float:
        return max(float(self.settings["maxspeed"]) / SPEED_SCALE, 1.0)
