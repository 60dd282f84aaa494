"""Work on many points in slices, on threads of its own; knows no points."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Answer = TypeVar("Answer")

_SLICE = 16_384


def in_slices(work: Callable[[int, int], Answer], count: int, threads: int) -> list[Answer]:
    """What `work(start, stop)` answers for slices that make up `count`, in their order.

    Raises
    ------
    ValueError : fewer than one thread.
    """
    if threads < 1:
        raise ValueError(f"at least 1 thread is needed, not {threads}")
    starts = range(0, count, _SLICE)
    stops = [min(start + _SLICE, count) for start in starts]
    if threads == 1 or len(starts) < 2:
        return [work(start, stop) for start, stop in zip(starts, stops, strict=True)]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, starts, stops))
