"""What a session asks of a source of scanlines, and what a source may tell its session; knows no source.

A source runs its own thread and hands frozen scanlines to a `Sink`; it knows no map, no record and no client.
"""

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np

from drivers.scanline import DeviceInfo, Float64Array, Scanline, SensorGeometry
from drivers.tally import PassTally
from scanner_service.analysis.intake import StoredLine
from scanner_service.analysis.passes import PassKey


class Sink(Protocol):
    """What a source may tell its session."""

    def line(self, line: Scanline | StoredLine) -> None:
        """A scanline, or one out of a record; waits while the session is busy."""

    def note(self, kind: str, details: dict[str, Any]) -> None:
        """Something happened: `interrupted`, `held`, `reconnected`, `resumed`, `not_resumed`, `rebooted`,
        `clock_jumped`, `advice`, `pass_ended`.

        `held`: the source goes on only when its `resume` is called.
        """

    def ended(self, failure: str | None) -> None:
        """Nothing more will come; `failure` says why when that was not planned."""


class Source(Protocol):
    """A place where scanlines come from.

    `geometry` is the scanner's optics and `towards_sensor` (3,) the direction of its z axis in the part frame; None
    when they are not known.
    """

    geometry: SensorGeometry | None
    towards_sensor: Float64Array | None

    def start(self, sink: Sink) -> None:
        """Begin to deliver; raises SourceUnusable or a DriverError when that cannot be done."""

    def stop(self) -> None:
        """Stop delivering and let go of everything; idempotent."""

    def tally(self) -> dict[str, Any] | None:
        """What the driver counted, None for a source without a wire."""

    def progress(self) -> float | None:
        """Share of the work that is done, None when the end is not known."""


@runtime_checkable
class Pausable(Protocol):
    """A source that can be held and go on."""

    def pause(self) -> None:
        """Deliver nothing more until `resume`; raises a DriverError when the device does not obey."""

    def resume(self) -> None:
        """Go on where it was held; raises a DriverError when that cannot be done: it is held still."""


@runtime_checkable
class OnAWire(Protocol):
    """A source whose driver keeps an account of each pass; `info` says which scanner it reads."""

    info: DeviceInfo

    def pass_tallies(self) -> Mapping[PassKey, PassTally]:
        """Chunks and lines of each pass."""


@runtime_checkable
class OnPorts(Protocol):
    """A source that holds serial ports from its making until it is stopped or at its end."""

    ports: tuple[str, ...]
    """As the user names them."""


def look_as_before(known: Source, source: Source) -> None:
    """Tell a source that follows another whether both look from the same side.

    When they do not, each pass is judged by its own rays.
    """
    before, now = known.towards_sensor, source.towards_sensor
    if before is None or now is None or not np.allclose(now, before):
        source.towards_sensor = None
