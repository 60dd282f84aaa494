"""Sources that deliver nothing by themselves: what a reopened session has left, and lines that a client pushes."""

from typing import Any

from drivers.scanline import Float64Array, SensorGeometry
from scanner_service.sessions.errors import SourceUnusable
from scanner_service.sessions.source import Sink


class SpentSource:
    """The source of a session that was reopened from the record: what it had is stored, nothing more comes.

    `geometry` and `towards_sensor` are those of the source that it had.
    """

    def __init__(
        self,
        geometry: SensorGeometry | None = None,
        towards_sensor: Float64Array | None = None,
    ) -> None:
        self.geometry = geometry
        self.towards_sensor = towards_sensor

    def start(self, sink: Sink) -> None:
        """Cannot be started again."""
        raise SourceUnusable("this session was reopened from the record; create another one to scan again")

    def stop(self) -> None:
        """Nothing to let go of."""

    def tally(self) -> dict[str, Any] | None:
        """There is no wire any more; what the driver had counted is in the record."""
        return None

    def progress(self) -> float | None:
        """Everything that was stored is there."""
        return 1.0


class PushSource:
    """Lines that a client pushes through the session itself: nothing to run, nothing that ends by itself."""

    geometry: SensorGeometry | None = None
    towards_sensor: Float64Array | None = None

    def start(self, sink: Sink) -> None:
        """Nothing to begin."""

    def stop(self) -> None:
        """Nothing to let go of."""

    def pause(self) -> None:
        """Nothing to hold: the session refuses lines."""

    def resume(self) -> None:
        """Nothing to go on with."""

    def tally(self) -> dict[str, Any] | None:
        """There is no wire."""
        return None

    def progress(self) -> float | None:
        """The end is not known."""
        return None
