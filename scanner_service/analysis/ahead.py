"""Has the system hand out the map's memory before scanlines need it; knows which rows are used, not what is in them.

A page is made when it is touched first. Where pages are large, or a virtual machine has to ask its host for them, that
takes some milliseconds, and the line that touches it would wait. So a thread of its own touches what comes next.
"""

import ctypes
import logging
import mmap
import os
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy.typing as npt

_LOG = logging.getLogger(__name__)
_POPULATE_WRITE = 23  # Linux 5.14 and later: madvise(2); what is in the pages stays
_PIECE_BYTES = 2 << 20
_LOW_PRIORITY = 10

Table = npt.NDArray[Any]


@dataclass(slots=True)
class _Stretch:
    """Tables that grow together, row by row: `reached` rows of each have memory."""

    tables: Sequence[Table]
    margin_rows: int
    reached: int = 0


class Ahead:
    """Keeps the tables' memory `margin` rows ahead of their use, where the system can; elsewhere it does nothing.

    Parameters
    ----------
    margins : rows to be ahead, of each stretch by its name.
    """

    def __init__(self, margins: Mapping[str, int]) -> None:
        self._margins = margins
        self._stretches: dict[str, _Stretch] = {}
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="memory-ahead", initializer=_be_modest)
        self._fetching: Future[None] | None = None
        self._closing = threading.Event()
        self._madvise = _system_call()

    def watch(self, name: str, tables: Sequence[Table]) -> None:
        """Look after these tables, whose rows are used in order, from now on instead of those of that name before."""
        self._stretches[name] = _Stretch(tables, self._margins[name])

    def use(self, rows: Mapping[str, int]) -> None:
        """Say how many rows of each stretch are used; never waits."""
        if self._madvise is None or (self._fetching is not None and not self._fetching.done()):
            return
        wanted: list[tuple[Sequence[Table], int, int]] = []
        for name, used in rows.items():
            stretch = self._stretches[name]
            if 2 * (stretch.reached - used) < stretch.margin_rows:
                start, stretch.reached = max(used, stretch.reached), used + stretch.margin_rows
                wanted.append((stretch.tables, start, stretch.reached))
        if wanted:
            self._fetching = self._pool.submit(self._fetch, wanted)

    def close(self) -> None:
        """End the thread."""
        self._closing.set()
        self._pool.shutdown()

    def _fetch(self, wanted: Sequence[tuple[Sequence[Table], int, int]]) -> None:
        for tables, start, end in wanted:
            for table in tables:
                row_bytes = table.strides[0]
                first = table.ctypes.data + min(start, len(table)) * row_bytes
                last = table.ctypes.data + min(end, len(table)) * row_bytes
                first -= first % mmap.PAGESIZE
                for at in range(first, last, _PIECE_BYTES):
                    if self._closing.is_set() or not self._touch(at, min(_PIECE_BYTES, last - at)):
                        return

    def _touch(self, address: int, n_bytes: int) -> bool:
        if self._madvise is None or self._madvise(address, n_bytes, _POPULATE_WRITE) == 0:
            return self._madvise is not None
        reason = os.strerror(ctypes.get_errno())
        _LOG.info("memory is not fetched ahead of scanlines: the system does not do it (%s)", reason)
        self._madvise = None
        return False


def _be_modest() -> None:
    """What fetches ahead gives way to what scans."""
    if hasattr(os, "setpriority"):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _LOW_PRIORITY)


def _system_call() -> Any:
    """madvise(2), which lets other threads run meanwhile; None where there is none."""
    try:
        madvise = ctypes.CDLL(None, use_errno=True).madvise
    except (OSError, AttributeError):
        return None
    madvise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
    return madvise
