"""From what a user asks for to a source that can be started: device, file or push; the one place that opens them."""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from drivers.rig import Rig
from drivers.scanners.native import NativeScanner
from scanner_service.sessions.errors import SourceUnusable
from scanner_service.sessions.sources import DeviceSource, PassRequest, PushSource, ReplaySource, Source
from scanner_service.storage.formats import FormatError, open_recording
from scanner_service.storage.formats.recording import ReadOptions

_PORT_PREFIXES = ("/dev/tty", "/dev/pts/", "/dev/serial/", "/dev/cu.")


@dataclass(frozen=True, slots=True)
class DeviceSpec:
    """One pass of a native scanner: the port and its rate, and the pass from `start_mm` to `end_mm` of the stage."""

    port: str
    baud_rate: int
    line_spacing_mm: float
    start_mm: float
    end_mm: float
    line_rate_hz: float

    def __post_init__(self) -> None:
        numbers = (self.line_spacing_mm, self.start_mm, self.end_mm, self.line_rate_hz)
        if not all(math.isfinite(value) for value in numbers):
            raise SourceUnusable("line spacing, start, end and line rate of a pass must be finite numbers")
        if self.line_spacing_mm <= 0:
            raise SourceUnusable(f"line spacing must be greater than 0 mm, not {self.line_spacing_mm}")
        if self.line_rate_hz <= 0 or self.baud_rate <= 0:
            raise SourceUnusable("line rate and baud rate must be greater than 0")
        if self.start_mm == self.end_mm:
            raise SourceUnusable(f"a pass from {self.start_mm} mm to {self.end_mm} mm has no length")

    def open(self) -> Source:
        """Open the port and greet the scanner; raises a DriverError when that fails, SourceUnusable for a bad path."""
        path = Path(self.port)
        if not str(path.resolve()).startswith(_PORT_PREFIXES):
            raise SourceUnusable(f"{self.port} is not a serial device: name one such as /dev/ttyUSB0")
        scanner = NativeScanner(self.port, self.baud_rate)
        info = scanner.enter()
        request = PassRequest(self.line_spacing_mm, self.start_mm, self.end_mm, self.line_rate_hz)
        return DeviceSource(scanner, Rig(), request, info)

    def to_dict(self) -> dict[str, Any]:
        """As it is kept in the record."""
        return {"kind": "device", **asdict(self)}


@dataclass(frozen=True, slots=True)
class ReplaySpec:
    """A recorded scan in a file of the service's own replay folder, or one that the operator of the machine names."""

    file: Path
    options: ReadOptions
    speed: float | None = None

    def open(self) -> Source:
        """Read the file; raises SourceUnusable when it cannot be understood."""
        if self.speed is not None and not (math.isfinite(self.speed) and self.speed > 0):
            raise SourceUnusable(f"the speed of a replay must be greater than 0, not {self.speed}")
        try:
            return ReplaySource(open_recording(self.file, self.options), self.speed)
        except (FormatError, OSError) as error:
            raise SourceUnusable(str(error)) from error

    def to_dict(self) -> dict[str, Any]:
        """As it is kept in the record."""
        return {"kind": "replay", "file": self.file.name, "speed": self.speed}


@dataclass(frozen=True, slots=True)
class PushSpec:
    """Scanlines that clients push."""

    def open(self) -> Source:
        """Nothing to open."""
        return PushSource()

    def to_dict(self) -> dict[str, Any]:
        """As it is kept in the record."""
        return {"kind": "push"}


SourceSpec = DeviceSpec | ReplaySpec | PushSpec
