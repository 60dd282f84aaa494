"""From what a user asks for to a source that can be started: device, file or push; the one place that opens them."""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from drivers.rig import Rig
from drivers.rig_file import read_rig
from drivers.rig_limits import PassOrder
from drivers.running_rig import RunningRig
from drivers.scanners.native import NativeScanner
from scanner_service.analysis.passes import pass_key
from scanner_service.sessions.calibration import calibration_after, geometry_from, towards_sensor_from
from scanner_service.sessions.device_source import DeviceSource, PassRequest
from scanner_service.sessions.errors import SourceUnusable
from scanner_service.sessions.left_regions import last_left
from scanner_service.sessions.replay_source import ReplaySource
from scanner_service.sessions.rig_source import Preparation, RigSource
from scanner_service.sessions.source import Source
from scanner_service.sessions.still_sources import PushSource
from scanner_service.sessions.withdrawals import withdrawn_passes
from scanner_service.storage.errors import RecordError
from scanner_service.storage.formats import ReadOptions, Recording, open_recording
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.rows import SessionRow

_PORT_PREFIXES = ("/dev/tty", "/dev/pts/", "/dev/serial/", "/dev/cu.")


@dataclass(frozen=True, slots=True)
class DeviceSpec:
    """One pass of a native scanner: the port and its rate, and the pass from `start_mm` to `end_mm` of the stage.

    `rearm`: see `PassRequest`.
    """

    port: str
    baud_rate: int
    line_spacing_mm: float
    start_mm: float
    end_mm: float
    line_rate_hz: float
    rearm: bool = False

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

    def open(self, rig: Rig | None = None) -> Source:
        """Open the port and greet the scanner, mounted as `rig` says (None: as by default).

        Raises a DriverError when that fails, SourceUnusable for a bad path.
        """
        try:
            path = Path(self.port).resolve()
        except (OSError, RuntimeError, ValueError) as error:  # a loop of links, a NUL, half a character
            raise SourceUnusable(f"{self.port!r} is not the path of a port: {error}") from error
        if not str(path).startswith(_PORT_PREFIXES):
            raise SourceUnusable(f"{self.port} is not a serial device: name one such as /dev/ttyUSB0")
        scanner = NativeScanner(self.port, self.baud_rate)
        info = scanner.enter()
        request = PassRequest(self.line_spacing_mm, self.start_mm, self.end_mm, self.line_rate_hz, self.rearm)
        return DeviceSource(scanner, rig or Rig(), request, info)

    def to_dict(self) -> dict[str, Any]:
        """As it is kept in the record."""
        return {"kind": "device", **asdict(self)}


@dataclass(frozen=True, slots=True)
class RigSpec:
    """One pass of a rig whose file lies in the service's own folder of rigs, or that the operator of the machine names.

    `speed_mm_per_s` None takes the fastest that keeps the line spacing, 0 measures each line at rest.
    """

    file: Path
    line_spacing_mm: float
    start_mm: float
    end_mm: float
    speed_mm_per_s: float | None = None
    home: bool = False
    at_mm: float | None = None

    def order(self) -> PassOrder:
        """The pass; raises SourceUnusable when its numbers are none of a pass."""
        try:
            speed = math.nan if self.speed_mm_per_s is None else self.speed_mm_per_s
            return PassOrder(self.start_mm, self.end_mm, self.line_spacing_mm, speed)
        except ValueError as error:
            raise SourceUnusable(str(error)) from None

    def open(self) -> Source:
        """Read the file, open both ports and greet both devices; raises SourceUnusable or a DriverError."""
        order, description = self.order(), read_rig(self.file)
        limits = description.limits
        why = limits.why_not(self.start_mm, self.end_mm) or limits.why_not_spaced(order)
        if why is not None:
            raise SourceUnusable(f"{why}; order another pass, or correct the rig file")
        rig = RunningRig(description)
        return RigSource(rig, order, rig.enter(), Preparation(self.home, self.at_mm), description)

    def to_dict(self) -> dict[str, Any]:
        """As it is kept in the record."""
        return {"kind": "rig", **asdict(self), "file": self.file.name}


@dataclass(frozen=True, slots=True)
class ReplaySpec:
    """A recorded scan in a file of the service's own replay folder, or one that the operator of the machine names."""

    file: Path
    options: ReadOptions
    speed: float | None = None

    def read(self) -> Recording:
        """Read the file; raises FormatError when it cannot be understood."""
        return open_recording(self.file, self.options)

    def open(self, recording: Recording | None = None) -> Source:
        """A source that plays the file, or the recording that was read from it; raises FormatError, SourceUnusable."""
        recording = recording or self.read()
        accounts = {"points_declared": recording.points_declared, "dropped": dict(recording.dropped)}
        return ReplaySource(recording.lines, len(recording.lines), accounts, self.speed)

    def to_dict(self) -> dict[str, Any]:
        """As it is kept in the record."""
        return {"kind": "replay", "file": self.file.name, "speed": self.speed}


@dataclass(frozen=True, slots=True)
class RecordSpec:
    """A session of a record, its own or another service's; played again it gives the same answers bit for bit."""

    reader: RecordReader
    session: SessionRow
    speed: float | None = None
    close: Callable[[], None] = lambda: None

    @classmethod
    def find(cls, reader: RecordReader, session_id: str | None, speed: float | None = None) -> "RecordSpec":
        """The session of that id, or the newest; raises SessionUnknown, or SourceUnusable for an empty record."""
        if session_id is not None:
            return cls(reader, reader.get_session(session_id), speed)
        newest = reader.list_sessions(1)
        if not newest:
            raise SourceUnusable("the record holds no session to replay")
        return cls(reader, newest[0], speed)

    @classmethod
    def of_file(cls, file: Path, session_id: str | None, speed: float | None) -> "RecordSpec":
        """The session of that id, or the newest, of a record in a file, which the source closes when it is played.

        Raises SourceUnusable when there is none, or the file is no record that this version can read.
        """
        try:
            reader = RecordReader.open(file)
        except RecordError as error:
            raise SourceUnusable(str(error).replace(str(file.resolve()), file.name)) from error
        try:
            return replace(cls.find(reader, session_id, speed), close=reader.close)
        except BaseException as error:
            reader.close()
            if isinstance(error, RecordError):
                raise SourceUnusable(f"{file.name}: {error}") from error
            raise

    def open(self) -> Source:
        """A source that plays the stored lines as they are, without the passes that were withdrawn.

        Raises SourceUnusable; the record is closed then, if it is the source's to close.
        """
        try:
            return self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> Source:
        events = list(self.reader.events(self.session.session_id))
        gone, kept = withdrawn_passes(events), calibration_after(self.session.calibration, events)
        lines = (line for _, line in self.reader.lines(self.session.session_id) if pass_key(line) not in gone)
        count = self.reader.count(self.session.session_id).lines
        source = ReplaySource(lines, count, None, self.speed, let_go=self.close)
        source.geometry, source.towards_sensor = geometry_from(kept), towards_sensor_from(kept)
        source.left = last_left(events)
        return source

    def to_dict(self) -> dict[str, Any]:
        """As it is kept in the record."""
        return {"kind": "record", "session": self.session.session_id}


@dataclass(frozen=True, slots=True)
class PushSpec:
    """Scanlines that clients push."""

    def open(self) -> Source:
        """Nothing to open."""
        return PushSource()

    def to_dict(self) -> dict[str, Any]:
        """As it is kept in the record."""
        return {"kind": "push"}


SourceSpec = DeviceSpec | RigSpec | ReplaySpec | RecordSpec | PushSpec


def let_go(spec: SourceSpec) -> None:
    """Close what a spec holds that will not be opened any more; perhaps twice."""
    if isinstance(spec, RecordSpec):
        spec.close()
