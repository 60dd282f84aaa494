"""The answer that is promised for a job of the writer, cheap enough for one a scanline; knows no job and no writer.

Python's own future brings a lock, a condition and some ten objects more, all of which the garbage collector looks at
again and again while lines wait. Answers that are given together share one door.
"""

import logging
import threading
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar, cast

T = TypeVar("T")
_log = logging.getLogger(__name__)


class Answer(Generic[T]):
    """A value, or an error, that will be there; behaves as Python's future does where that is needed here."""

    __slots__ = ("_calls", "_door", "_error", "_is_there", "_value")

    def __init__(self, door: threading.Condition) -> None:
        self._door = door
        self._is_there = False
        self._value: T | None = None
        self._error: BaseException | None = None
        self._calls: list[Callable[[Answer[T]], object]] | None = None

    def done(self) -> bool:
        """True once it is there."""
        return self._is_there

    def result(self, timeout_s: float | None = None) -> T:
        """The value, waited for; raises the error that came instead, TimeoutError when nothing comes in time."""
        error = self.exception(timeout_s)
        if error is not None:
            raise error
        return cast("T", self._value)

    def exception(self, timeout_s: float | None = None) -> BaseException | None:
        """The error, waited for, None when there is a value; raises TimeoutError when nothing comes in time."""
        if not self._is_there:
            with self._door:
                if not self._door.wait_for(self.done, timeout_s):
                    raise TimeoutError
        return self._error

    def add_done_callback(self, call: "Callable[[Answer[T]], object]") -> None:
        """Call it with this answer once it is there, in the thread that gives it; at once when it is there already."""
        with self._door:
            if not self._is_there:
                self._calls = [*(self._calls or ()), call]
                return
        call(self)

    def _take(self, given: Any) -> None:
        if isinstance(given, BaseException):
            self._error = given
        else:
            self._value = given
        self._is_there = True


def give(answers: Sequence[Answer[Any]], given: Sequence[Any], door: threading.Condition) -> None:
    """Give each answer its value, or its error, all at the same moment; then do what was to be done after each."""
    with door:
        for answer, value in zip(answers, given, strict=True):
            answer._take(value)
        door.notify_all()
    for answer in answers:
        calls, answer._calls = answer._calls or (), None
        for call in calls:
            try:
                call(answer)
            except Exception:  # noqa: BLE001 - whoever wanted to be called must not keep the others from it
                _log.exception("what was to follow an answer of the record failed")
