"""What a source says, and what follows from it for the course of its session; knows no user and no verdict."""

import logging
from collections import deque
from collections.abc import Callable
from typing import Any

from drivers.scanline import Scanline
from scanner_service.analysis.intake import StoredLine
from scanner_service.sessions.course import Course
from scanner_service.sessions.engine import Engine
from scanner_service.sessions.errors import SessionError
from scanner_service.sessions.lost_ends import LOST_END

_LOG = logging.getLogger(__name__)


class Hearing:
    """The `Sink` of one session: lines go to its engine, events into its record by `write_event`.

    `stop_source` is called when the engine takes no more lines; `finish` when the source is used up, with why if that
    was not planned.
    """

    def __init__(
        self,
        engine: Engine,
        course: Course,
        write_event: Callable[[str, dict[str, Any]], None],
        stop_source: Callable[[], None],
        finish: Callable[[str | None], None],
    ) -> None:
        self.engine = engine
        self._course = course
        self._write_event = write_event
        self._stop_source = stop_source
        self._finish = finish
        self._latest: deque[tuple[Scanline, float]] = deque(maxlen=8)

    def line(self, line: Scanline | StoredLine) -> None:
        """A scanline; when the engine is gone, it is counted there and the source is told to stop."""
        if self._course.state == "paused" and not self._course.is_held:
            self.note("resumed", {})  # lines flow again, whatever was or was not said of the link
        if isinstance(line, Scanline):
            self.remember(line)
        try:
            self.engine.put(line)
        except SessionError as error:
            _LOG.warning("a scanline of session %s was not taken: %s", self.engine.session_id, error)
            self._stop_source()

    def note(self, kind: str, details: dict[str, Any]) -> None:
        """An event: goes into the record, and may pause or resume the session."""
        self._write_event(kind, details)
        match kind:
            case "interrupted":
                self._course.wait_for_return(f"the scanner is gone ({details.get('reason')}); waiting for it to return")
            case "held":
                self._course.hold(
                    "the pass was interrupted for too long to go on by itself, and the laser is off: "
                    f"resume it to go on at {details.get('from_mm')} mm, or stop it"
                )
            case "resumed":
                self._course.go_on()
            case kind if kind == LOST_END:
                self._course.remark = str(details["message"])

    def ended(self, failure: str | None) -> None:
        """The source is used up."""
        if self._course.is_under_way:
            self._finish(failure)

    def remember(self, line: Scanline) -> None:
        """This scanline has come last."""
        self._latest.append((line, self._course.time.now_s()))

    def latest_lines(self) -> list[tuple[Scanline, float]]:
        """The last few scanlines with the seconds at which they came, the oldest first."""
        return list(self._latest)
