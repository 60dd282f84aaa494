"""Memory fetched ahead of its use: it is there before it is touched, and what is in it stays."""

import mmap
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from scanner_service.analysis.ahead import Ahead
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings

ROWS = 1 << 20


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * mmap.PAGESIZE


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux hands out memory ahead of its use")
def test_as_many_rows_have_memory_as_were_asked_for_and_what_was_written_stays() -> None:
    fresh = mmap.mmap(-1, ROWS * 128)  # 128 MB of which nothing is there; np.empty may give what was used before
    table = np.frombuffer(fresh, dtype=np.float64).reshape(ROWS, 16)
    table[:1000] = 7.0
    ahead = Ahead({"table": ROWS // 4})
    before = resident_bytes()
    ahead.watch("table", (table,))
    ahead.use({"table": 1000})
    assert ahead._fetching is not None
    ahead._fetching.result()
    grown = resident_bytes() - before
    ahead.close()
    if ahead._madvise is None:
        pytest.skip("this kernel has no MADV_POPULATE_WRITE")
    assert 0.9 * table.nbytes / 4 < grown < 1.5 * table.nbytes / 4
    assert (table[:1000] == 7.0).all()


def test_the_end_of_a_table_is_never_passed() -> None:
    table = np.zeros((1000, 3))
    ahead = Ahead({"table": 1 << 20})
    ahead.watch("table", (table, np.zeros(10)))
    ahead.use({"table": 990})
    ahead.use({"table": 1000})
    ahead.close()
    assert not table.any()


def test_a_closed_map_leaves_no_thread_behind() -> None:
    before = set(threading.enumerate())
    live_map = LiveMap(MapSettings(max_points=1000))
    live_map._ahead.use({"points": 10})
    live_map.close()
    deadline_s = time.monotonic() + 10.0
    while set(threading.enumerate()) - before and time.monotonic() < deadline_s:
        time.sleep(0.01)
    assert set(threading.enumerate()) == before
