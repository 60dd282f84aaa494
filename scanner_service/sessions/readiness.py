"""Whether scans can begin without waiting for a compiler: loads or compiles all once a process, says how far it is."""

import gc
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from numba.core import event

from scanner_service.analysis.compiling import compile_kernels
from scanner_service.rescan.cuts import compile_cuts
from scanner_service.rescan.passes.compiling import compile_planner
from scanner_service.rescan.requirement import Requirement
from scanner_service.sessions.errors import KernelsCompiling
from scanner_service.sessions.kernel_caches import mark_used, remove_unused
from scanner_service.sessions.results import judge
from scanner_service.storage.packing import compile_packing

STEPS = ("the packing of lines", "the live map", "the verdict", "the planner of passes")
"""What is compiled, or loaded from the cache, in this order."""

_LOCK = threading.Lock()
_READY = threading.Event()


@dataclass(frozen=True, slots=True)
class Preparing:
    """What is being prepared: step `step` of `of`, `seconds` after the beginning of all.

    `compiles`: something had to be compiled so far, and was not loaded from the cache.
    """

    what: str
    step: int
    of: int
    seconds: float
    compiles: bool

    def __str__(self) -> str:
        verb = "compiling" if self.compiles else "loading"
        return f"{verb} {self.what}, step {self.step} of {self.of}, for {self.seconds:.0f} s now"


@dataclass(slots=True)
class _Course:
    """How far it is; written by the thread that prepares."""

    step: int = 0  # of those that are counted from 1; 0 before the first
    begun_s: float = 0.0
    compiles: bool = False


class _Compilations(event.Listener):
    """Hears of each kernel that is compiled; of those that are loaded nothing is said."""

    def on_start(self, _event: Any) -> None:
        _COURSE.compiles = True

    def on_end(self, _event: Any) -> None:
        pass


_COURSE = _Course()


def kernels_are_ready() -> bool:
    """True once every kernel is compiled in this process."""
    return _READY.is_set()


def preparing(clock: Callable[[], float] = time.monotonic) -> Preparing | None:
    """What is being compiled or loaded just now; None when nothing is."""
    step, begun_s = _COURSE.step, _COURSE.begun_s
    if _READY.is_set() or not step:
        return None
    return Preparing(STEPS[step - 1], step, len(STEPS), max(0.0, clock() - begun_s), _COURSE.compiles)


def refuse_until_ready() -> None:
    """Raise KernelsCompiling, which says how far that is, as long as kernels are compiled."""
    if not _READY.is_set():
        told = preparing()
        how_far = f" ({told})" if told is not None else ""
        raise KernelsCompiling(
            f"the service is not ready yet: it loads its kernels, which after an installation are compiled once, for a "
            f"minute or two{how_far}; try again in a moment, GET /readyz says when"
        )


def warm_up() -> None:
    """Compile every kernel of record, map, regions and passes, or load it from the cache; at once when it was done.

    What is in memory by then stays there: the garbage collector is told not to look at it. A full collection, which
    holds up every thread, otherwise goes through some 300,000 objects of libraries, for a fifth of a second.
    """
    with _LOCK:
        if _READY.is_set():
            return
        _COURSE.step, _COURSE.begun_s = 1, time.monotonic()
        try:
            mark_used()
            with event.install_listener("numba:compile", _Compilations()):
                compile_packing()
                _COURSE.step = 2
                snapshot = compile_kernels()
                _COURSE.step = 3
                compile_cuts()
                report = judge(snapshot, Requirement()).report
                _COURSE.step = 4
                compile_planner(snapshot, report)
        finally:
            _COURSE.step = 0
        mark_used()  # it may not have been there before
        remove_unused()
        gc.freeze()
        _READY.set()
