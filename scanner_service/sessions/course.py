"""The course of one session: its state, what holds it, how long it has scanned; knows no source, no map, no record.

Two locks, and nobody waits for a disk with either of them in hand: a short one to look and to set, and the `turn` of
those who want something of the source, which a device may take its time with.
"""

import contextlib
import threading
from collections.abc import Callable, Iterator

from scanner_service.sessions.errors import SessionBusy
from scanner_service.sessions.scan_clock import ScanClock

_ENDED = ("stopped", "failed")


class Course:
    """Where a session stands; `write_state` takes each state that is to be kept, and must not wait."""

    def __init__(self, state: str, clock: Callable[[], float], write_state: Callable[[str], None]) -> None:
        self.time = ScanClock(clock)
        self.turn = threading.RLock()
        self.message: str | None = None
        self.remark: str | None = None  # what its last pass leaves to be said
        self._state = state
        self._is_held = False
        self._is_ending = False
        self._pushing = 0  # lines that are being handed over
        self._write_state = write_state
        self._change = threading.Condition()

    @property
    def state(self) -> str:
        """One of `status.STATES`; `scanning` or `paused` until the last verdict is there."""
        return self._state

    @property
    def is_held(self) -> bool:
        """True in a pause that lasts until somebody resumes."""
        return self._is_held

    @property
    def is_ending(self) -> bool:
        """True while the passes are closed and the scan is judged for the last time."""
        return self._is_ending

    @property
    def is_under_way(self) -> bool:
        """True while lines may come."""
        return self._state in ("scanning", "paused")

    @property
    def has_ended(self) -> bool:
        """True once it is stopped or failed, and judged if it can be."""
        return self._state in _ENDED

    # -- with the turn in hand ----------------------------------------------------------------------------------

    def check(self, states: tuple[str, ...], advice: str) -> None:
        """Raise SessionBusy unless the session is in one of these states, and not about to end."""
        if self._is_ending:
            raise SessionBusy("the session is being stopped and judged: wait until that is done")
        if self._state not in states:
            raise SessionBusy(f"the session is {self._state}{advice}")

    def check_start(self, again: bool) -> None:
        """Raise SessionBusy unless the session may begin to scan; `again`: also when it has ended."""
        states = ("created", "stopped", "failed", "interrupted") if again else ("created",)
        advice = {"scanning": " already", "paused": ": resume it"}
        self.check(states, advice.get(self._state, "; create another one to scan again"))

    @contextlib.contextmanager
    def setting_out(self) -> Iterator[None]:
        """While a source is being started the session scans: a short one may have ended before it is.

        When it does not start, the state is what it was; when it does, an earlier failure is over.
        """
        with self._change:
            before, said = self._state, self.message
            self._state = "scanning"
            self.remark = None
            if before == "failed":
                self.message = None
            self.time.start()
        try:
            yield
        except BaseException:
            with self._change:
                if not self._is_ending:
                    self.time.stop()
                    self._state, self.message = before, said
            raise
        with self._change:
            self._write_state(self._state)

    @contextlib.contextmanager
    def holding(self, message: str) -> Iterator[None]:
        """While a source is being held: lines still on their way must not look like a scanner that came back.

        Held it is then, unless the scanner went meanwhile: that one is waited for.
        """
        self._is_held = True
        try:
            yield
        except BaseException:
            self._is_held = False
            raise
        with self._change:
            if self._state == "scanning":
                self.hold(message)
            else:
                self._is_held = False

    def release(self) -> None:
        """A pause that was held is over, and lines flow again: at once, so that none looks like a scanner's return."""
        with self._change:
            self._is_held = False
            self.time.start()
            self.go_on()

    def begin_to_end(self) -> bool:
        """No line is taken from now on; False when it has ended, or another thread ends it.

        Waits for the turn: what is just being started has started then, or never does.
        """
        with self.turn, self._change:
            if self.has_ended or self._is_ending:
                return False
            self._is_ending = True
            self.time.stop()
            return True

    # -- at any time --------------------------------------------------------------------------------------------

    def hold(self, message: str) -> None:
        """The scan stands until somebody resumes it."""
        with self._change:
            if self._may_move:
                self._is_held = True
                self.time.stop()
                self.wait_for_return(message)

    def wait_for_return(self, message: str) -> None:
        """The scan stands until its scanner is back."""
        self._move("paused", message)

    def go_on(self) -> None:
        """Lines flow again; a scan that is held stays so."""
        if not self._is_held:
            self._move("scanning", None)

    @property
    def _may_move(self) -> bool:
        """False when it is over, or about to be: what a source says then changes nothing of that."""
        return self.is_under_way and not self._is_ending

    def _move(self, state: str, message: str | None) -> None:
        with self._change:
            if self._may_move:
                self._state, self.message = state, message
                self._write_state(state)

    @contextlib.contextmanager
    def line_handed_over(self) -> Iterator[None]:
        """A line is before the end of the scan, and judged, or refused: raises SessionBusy."""
        with self._change:
            verb = "resume" if self._state == "paused" else "start"
            self.check(("scanning",), f": {verb} it before pushing scanlines")
            self._pushing += 1
        try:
            yield
        finally:
            with self._change:
                self._pushing -= 1
                self._change.notify_all()

    def wait_for_lines(self) -> None:
        """Wait until no line is being handed over; behind `begin_to_end` there is no other."""
        with self._change:
            self._change.wait_for(lambda: not self._pushing)

    def end(self, state: str, message: str | None) -> None:
        """It has ended."""
        with self._change:
            if message is not None or self._state == "paused":
                self.message = message  # a scan that is over waits for nothing
            self._state, self._is_held, self._is_ending = state, False, False
            self._change.notify_all()

    def fail_to_end(self) -> None:
        """Whoever wanted to end it could not; somebody else may try."""
        with self._change:
            self._is_ending = False
            self._change.notify_all()

    def wait_until_ended(self, timeout_s: float | None = None) -> bool:
        """Wait until the session has ended; False when not after `timeout_s`."""
        with self._change:
            return self._change.wait_for(lambda: self.has_ended, timeout_s)

    def wait_for_the_other(self) -> None:
        """Wait until the thread that ends it has done so, or has given up."""
        with self._change:
            self._change.wait_for(lambda: not self._is_ending)
