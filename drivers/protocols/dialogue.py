"""A conversation written down as a script: say, wait, go on; knows no protocol, no port and no clock.

A script is a generator. It yields what it waits for and is sent what came of it, so that a handshake of ten steps
reads as ten lines, and can still be driven byte by byte in simulated time.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

from drivers.errors import ScannerError
from drivers.protocols.listening import listened_s

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Answer:
    """Wait for an item of the stream; the script is sent that item, or None after `within_s`."""

    accepts: Callable[[Any], bool]
    within_s: float


@dataclass(frozen=True, slots=True)
class Quiet:
    """Wait until no byte has come for `for_s`; the script is sent True, or False when `within_s` was not enough."""

    for_s: float
    within_s: float


@dataclass(frozen=True, slots=True)
class Pause:
    """Wait for `for_s`, whatever comes."""

    for_s: float


Wait: TypeAlias = Answer | Quiet | Pause
Script: TypeAlias = Generator[Wait, Any, T]


class Dialogue:
    """A script under way. `done` is called with its result, `failed` with the ScannerError that it raised."""

    def __init__(
        self,
        script: Script[Any],
        now_s: float,
        done: Callable[[Any, float], None],
        failed: Callable[[ScannerError, float], None],
    ) -> None:
        self._script = script
        self._done = done
        self._failed = failed
        self._wait: Wait | None = None
        self._since_s = self._heard_s = self._ticked_s = now_s
        self._listened_s = 0.0
        self.is_over = False

    def begin(self, now_s: float) -> None:
        """Run up to the first wait."""
        self._go_on(None, now_s)

    def heard(self, now_s: float) -> None:
        """Note that bytes have come, whatever they say."""
        self._heard_s = now_s

    def offer(self, item: object, now_s: float) -> bool:
        """Give the script an item; True when it was waiting for it."""
        if isinstance(self._wait, Answer) and self._wait.accepts(item):
            self._go_on(item, now_s)
            return True
        return False

    def tick(self, now_s: float) -> None:
        """Go on where the wait is over by now; for an answer only the time counts in which it could be heard."""
        waited_s = now_s - self._since_s
        self._listened_s += listened_s(max(self._ticked_s, self._since_s), now_s)
        self._ticked_s = now_s
        match self._wait:
            case Answer(within_s=within_s) if self._listened_s >= within_s:
                self._go_on(None, now_s)
            case Pause(for_s=for_s) if waited_s >= for_s:
                self._go_on(None, now_s)
            case Quiet(for_s=for_s) if now_s - max(self._heard_s, self._since_s) >= for_s:
                self._go_on(True, now_s)
            case Quiet(within_s=within_s) if waited_s >= within_s:
                self._go_on(False, now_s)

    def abandon(self) -> None:
        """Stop where it is; nobody is told."""
        self.is_over = True
        self._wait = None
        self._script.close()

    def _go_on(self, answer: object, now_s: float) -> None:
        self._since_s = now_s
        self._listened_s = 0.0
        self._wait = None
        try:
            wait = self._script.send(answer)
        except StopIteration as end:
            self.is_over = True
            self._done(end.value, now_s)
        except ScannerError as error:
            self.is_over = True
            self._failed(error, now_s)
        else:
            if not self.is_over:
                self._wait = wait
