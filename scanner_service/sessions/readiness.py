"""Whether scans can begin without waiting for a compiler: compiles everything once a process."""

import gc
import threading

from scanner_service.analysis.compiling import compile_kernels
from scanner_service.rescan.cuts import compile_cuts
from scanner_service.rescan.passes.compiling import compile_planner
from scanner_service.rescan.requirement import Requirement
from scanner_service.sessions.kernel_caches import mark_used, remove_unused
from scanner_service.sessions.results import judge
from scanner_service.storage.packing import compile_packing

_LOCK = threading.Lock()
_READY = threading.Event()


def kernels_are_ready() -> bool:
    """True once every kernel is compiled in this process."""
    return _READY.is_set()


def warm_up() -> None:
    """Compile every kernel of record, map, regions and passes, or load it from the cache; at once when it was done.

    What is in memory by then stays there: the garbage collector is told not to look at it. A full collection, which
    holds up every thread, otherwise goes through some 300,000 objects of libraries, for a fifth of a second.
    """
    with _LOCK:
        if not _READY.is_set():
            mark_used()
            compile_packing()
            snapshot = compile_kernels()
            compile_cuts()
            compile_planner(snapshot, judge(snapshot, Requirement()).report)
            mark_used()  # it may not have been there before
            remove_unused()
            gc.freeze()
            _READY.set()
