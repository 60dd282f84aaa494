"""Scanlines that were recorded, played as fast as they are taken or at the pace at which they were measured."""

import logging
import math
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any

from drivers.scanline import Float64Array, Scanline, SensorGeometry
from scanner_service.analysis.intake import StoredLine
from scanner_service.sessions.errors import SourceUnusable
from scanner_service.sessions.left_regions import LeftRegions
from scanner_service.sessions.source import Sink
from scanner_service.storage.errors import RecordError

_LOG = logging.getLogger(__name__)


class ReplaySource:
    """Recorded scanlines, played as fast as they are taken or at `speed` times the pace of their device times.

    `accounts` is what the file held and what of it could not be used, `line_count` how many lines there are.
    `let_go` is called, perhaps twice, when no more of them will be read; `left` are the regions that another playing
    of the same lines left. Raises SourceUnusable when `speed` is not a
    pace.
    """

    def __init__(
        self,
        lines: Iterable[Scanline] | Iterable[StoredLine],
        line_count: int,
        accounts: dict[str, Any] | None = None,
        speed: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        let_go: Callable[[], None] = lambda: None,
    ) -> None:
        if speed is not None and not (math.isfinite(speed) and speed > 0):
            raise SourceUnusable(f"the speed of a replay must be greater than 0, not {speed}")
        self.geometry: SensorGeometry | None = None
        self.towards_sensor: Float64Array | None = None
        self.left: LeftRegions | None = None
        self._lines = lines
        self._line_count = line_count
        self._accounts = accounts
        self._speed = speed
        self._clock = clock
        self._let_go = let_go
        self._played = 0
        self._going = threading.Event()
        self._going.set()
        self._held_s = 0.0
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, sink: Sink) -> None:
        """Begin to play."""
        self._thread = threading.Thread(target=self._play, args=(sink,), name="replay-source", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop playing."""
        self._stopping.set()
        self._going.set()
        if self._thread is None:
            self._let_go()
        elif self._thread is not threading.current_thread():
            self._thread.join()

    def pause(self) -> None:
        """Hold the replay."""
        self._going.clear()

    def resume(self) -> None:
        """Play on."""
        self._going.set()

    def tally(self) -> dict[str, Any] | None:
        """What the file held, and what of it could not be used."""
        return self._accounts

    def progress(self) -> float | None:
        """Share of the lines that were played."""
        return self._played / self._line_count if self._line_count else 1.0

    def _play(self, sink: Sink) -> None:
        begun_s = self._clock()
        first_s: float | None = None
        failure: str | None = None
        try:
            for line in self._lines:
                first_s = line.device_time_s if first_s is None else first_s
                self._wait_while_held()
                if self._speed is not None:
                    due_s = (line.device_time_s - first_s) / self._speed + self._held_s
                    self._stopping.wait(max(0.0, due_s - (self._clock() - begun_s)))
                if self._stopping.is_set():
                    break
                sink.line(line)
                self._played += 1
            else:
                self._line_count = self._played  # a record may hold lines of withdrawn passes, which are not played
        except RecordError as error:
            failure = str(error)
        except Exception as error:  # noqa: BLE001 - the thread's loop: the session is told, or it would never end
            _LOG.exception("the replay stopped")
            failure = f"the replay stopped by an internal fault: {error}"
        self._let_go()
        sink.ended(failure)

    def _wait_while_held(self) -> None:
        if not self._going.is_set():
            held_s = self._clock()
            self._going.wait()
            self._held_s += self._clock() - held_s
