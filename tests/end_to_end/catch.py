"""What has come from a scanner behind a pseudo-terminal, and that neither thread nor descriptor outlives it."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from drivers.protocols.scanner_events import ScannerEvent
from drivers.scanline import Profile
from drivers.scanners.face import Scanner
from tests.end_to_end.running import PATIENCE_S


def open_descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir())) if Path("/proc/self/fd").exists() else 0


@contextlib.contextmanager
def nothing_left() -> Iterator[None]:
    """No thread and no descriptor survives the block."""
    threads, descriptors = set(threading.enumerate()), open_descriptors()
    yield
    assert set(threading.enumerate()) <= threads
    assert open_descriptors() == descriptors


class Catch:
    """What has come from a scanner so far, lines and events apart."""

    def __init__(self, scanner: Scanner) -> None:
        self.lines: list[Profile] = []
        self.told: list[ScannerEvent] = []
        self._scanner = scanner

    def until(self, enough: Callable[[], bool]) -> None:
        """Fetch until enough has come; the patience is for a machine under load, not a measurement."""
        deadline = threading.Event()
        timer = threading.Timer(PATIENCE_S, deadline.set)
        timer.start()
        try:
            while not enough():
                assert not deadline.is_set(), (self.told, len(self.lines), self._scanner.tally())
                for item in self._scanner.events(0.05):
                    if isinstance(item, Profile):
                        self.lines.append(item)
                    else:
                        self.told.append(item)
        finally:
            timer.cancel()
            timer.join()

    def count(self, kind: type) -> int:
        return sum(isinstance(event, kind) for event in self.told)
