"""Which scanlines hold the returns before and after those of others under the same rays; knows columns, no points."""

import numpy as np

from drivers.scanline import BoolArray
from scanner_service.rescan.stations import IntArray, Stations


def partners(stations: Stations, columns: list[IntArray], lines: BoolArray, returns: int) -> BoolArray:
    """(L,) True for the lines with one of the so many nearest returns on either side of some lines (L,).

    `columns` are, of each line, those of the fan in which it has returns, each once.
    """
    found = np.zeros(len(lines), dtype=bool)
    for number in np.unique(stations.group[lines]).tolist():
        mine = np.flatnonzero((stations.group == number) & (stations.rank >= 0))
        mine = mine[np.argsort(stations.rank[mine])]
        place = np.flatnonzero(lines[mine])
        for run in np.split(place, np.flatnonzero(np.diff(place) > 1) + 1) if len(place) else ():
            wanted = np.unique(np.concatenate([columns[line] for line in mine[run].tolist()]))
            for others in (mine[: run[0]][::-1], mine[run[-1] + 1 :]):
                _walk(others, columns, wanted, returns, found)
    return found


def _walk(lines: IntArray, columns: list[IntArray], wanted: IntArray, returns: int, found: BoolArray) -> None:
    """Mark lines, going on until each of the wanted columns has had so many returns, or there are no more lines."""
    if not len(wanted):
        return
    low, high = int(wanted[0]), int(wanted[-1])
    need = np.zeros(high - low + 1, dtype=np.int64)
    need[wanted - low] = returns
    left = len(wanted)
    for line in lines.tolist():
        there = columns[line]
        there = there[(there >= low) & (there <= high)] - low
        there = there[need[there] > 0]
        if len(there):
            found[line] = True
            need[there] -= 1
            left -= int((need[there] == 0).sum())
            if not left:
                return
