"""Waiting that counts only the time in which this program was let run; knows no device and decides nothing."""

import math
import threading
from collections.abc import Callable

from drivers.protocols.listening import LISTENED_S


def wait_patiently(changed: threading.Condition, is_over: Callable[[], object], timeout_s: float) -> bool:
    """Wait on `changed`, whose lock the caller holds, until `is_over`; return False after `timeout_s` of listening.

    A pause of the whole process, however long, counts as `LISTENED_S` at most; whoever notifies has its turn after it.
    """
    turns = max(1, math.ceil(timeout_s / LISTENED_S))
    return any(changed.wait_for(is_over, timeout_s / turns) for _ in range(turns))
