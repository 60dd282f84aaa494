"""What a piece of work costs this process: processor time and the growth of its memory at the peak."""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

Value = TypeVar("Value")
_STATUS = Path("/proc/self/status")
_CLEAR = Path("/proc/self/clear_refs")


def measured(work: Callable[[], Value]) -> tuple[Value, float, float]:
    """The work's value, its processor seconds, and bytes by which the resident memory grew at most.

    Memory is NaN where the system does not tell the peak (it is asked of Linux).
    """
    before = _peak_bytes() if _forget_peak() else math.nan
    begun = time.process_time()
    value = work()
    seconds = time.process_time() - begun
    return value, seconds, _peak_bytes() - before


def _forget_peak() -> bool:
    try:
        _CLEAR.write_text("5")
    except OSError:
        return False
    return True


def _peak_bytes() -> float:
    try:
        for line in _STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024.0 * int(line.split()[1])
    except OSError:
        pass
    return math.nan
