"""Whether a pass is to end: from the moment that somebody says so nothing sets off any more; knows no device."""

import contextlib
import threading
from collections.abc import Iterator

from drivers.errors import StageStopped

_SETTING_OFF_S = 1.0


class Stopping:
    """A stop that stays: it cannot be taken back, and a motion either began before it or does not begin."""

    def __init__(self) -> None:
        self._said = threading.Event()
        self._setting_off = threading.Lock()

    def is_set(self) -> bool:
        """True once a stop was asked for."""
        return self._said.is_set()

    def set(self) -> None:
        """Let nothing begin from now on.

        What sets off at this moment in another thread has done so on return, so that a stop that is sent next comes
        after it. A device that takes longer than a second to set off is not waited for: the stop is worth more.
        """
        self._said.set()
        if self._setting_off.acquire(timeout=_SETTING_OFF_S):
            self._setting_off.release()

    def refuse(self) -> None:
        """Raise StageStopped once a stop was asked for."""
        if self._said.is_set():
            raise StageStopped("the rig was stopped; nothing sets off until it is entered anew")

    @contextlib.contextmanager
    def before_it(self) -> Iterator[None]:
        """Hold a stop back for the moment in which something sets off; raises StageStopped when it came first."""
        with self._setting_off:
            self.refuse()
            yield
