"""A verdict that somebody waits for: why, for how long, and which of its steps is being taken; judges nothing."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

Why = Literal["scan_ended", "asked_anew"]

STEPS = ("reading the map", "looking for regions", "measuring coverage", "following the regions")
"""In the order in which they are taken; the second takes by far the longest."""

_BEFORE: dict[Why, str] = {"scan_ended": "storing the last scanlines", "asked_anew": "waiting for its turn"}


@dataclass(frozen=True, slots=True)
class Awaited:
    """What is told of it. `share`: of the steps that are done, 0 to 1."""

    why: Why
    step: str
    share: float
    for_s: float


class AwaitedVerdict:
    """The verdict that is waited for, if there is one; of several, the one that was asked for last is told."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._lock = threading.Lock()
        self._waiting: dict[object, tuple[Why, float, str]] = {}

    @contextlib.contextmanager
    def awaited(self, why: Why) -> Iterator[Callable[[str], None]]:
        """While somebody waits; gives what is to be called with each step that begins."""
        mark, begun_s = object(), self._now_s()

        def begins(step: str) -> None:
            with self._lock:
                self._waiting[mark] = why, begun_s, step

        begins(_BEFORE[why])
        try:
            yield begins
        finally:
            with self._lock:
                del self._waiting[mark]

    def told(self) -> Awaited | None:
        """How far it is; None when nobody waits for one."""
        with self._lock:
            if not self._waiting:
                return None
            why, begun_s, step = list(self._waiting.values())[-1]
        taken = (_BEFORE[why], *STEPS)
        return Awaited(why, step, taken.index(step) / len(taken), self._now_s() - begun_s)
