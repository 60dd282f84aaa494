"""How long a session has scanned, over all its starts and without its pauses; knows no session."""

from collections.abc import Callable


class ScanClock:
    """A clock that is started, and stopped; `clock` tells seconds."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self.now_s = clock
        self._earlier_s = 0.0
        self._begun_s: float | None = None

    def go_on_from(self, seconds: float) -> None:
        """So long was scanned before."""
        self._earlier_s, self._begun_s = seconds, None

    def start(self) -> None:
        """The scan begins, or goes on."""
        self._earlier_s = self.elapsed_s()
        self._begun_s = self.now_s()

    def stop(self) -> None:
        """The scan is held, or over; idempotent."""
        self._earlier_s, self._begun_s = self.elapsed_s(), None

    def elapsed_s(self) -> float:
        """Seconds of scanning up to now."""
        return self._earlier_s + (0.0 if self._begun_s is None else self.now_s() - self._begun_s)
