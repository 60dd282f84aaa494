"""Two hashes: of what was stored and of what was found in it; equal means equal to the last bit; judges nothing."""

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import fields

import numpy as np

from scanner_service.analysis.intake import StoredLine
from scanner_service.rescan.reference import ReferenceCoverage
from scanner_service.sessions.results import Results
from scanner_service.storage.encoding import PLAIN, encode_line


class RawHash:
    """SHA-256 over the lines of a session in the order of their numbers, each in the plain encoding (`docs/record.md`).

    The plain one whichever they are stored in, so that the hash of a line never changes.
    """

    def __init__(self) -> None:
        self._digest = hashlib.sha256()
        self.lines = 0

    def add(self, line: StoredLine) -> None:
        """Take in the next line."""
        self._digest.update(encode_line(line, PLAIN))
        self.lines += 1

    def hexdigest(self) -> str:
        """The hash so far."""
        return self._digest.hexdigest()


def raw_sha256(lines: Iterable[StoredLine]) -> str:
    """The hash of all these lines."""
    digest = RawHash()
    for line in lines:
        digest.add(line)
    return digest.hexdigest()


def verdict_sha256(results: Results) -> str:
    """SHA-256 over everything that is said of every point, every region, every cell and the nominal part.

    The version of the map is left out, since it counts readings, which differ from one playing to the next.
    """
    digest = hashlib.sha256()
    for name, content in _parts(results):
        digest.update(f"{name}:{len(content)}:".encode())
        digest.update(content)
    return digest.hexdigest()


def _parts(results: Results) -> Iterator[tuple[str, bytes]]:
    for thing in (results.snapshot, results.snapshot.lines, results.coverage):
        for item in fields(thing):
            value = getattr(thing, item.name)
            if isinstance(value, np.ndarray):
                yield item.name, _bytes(value)
            elif isinstance(value, float):
                yield item.name, np.float64(value).tobytes()
    yield "rescan", _bytes(results.report.rescan)
    yield "verdict", _bytes(results.report.reason)
    if results.reference is not None:
        yield "reference", _areas(results.reference)
    untouched = results.reference.untouched if results.reference is not None else ()
    for region in (*results.report.regions, *untouched):
        told = (region.number, int(region.reason), region.point_count)
        yield "region", repr(told).encode()
        numbers = (region.area_mm2, region.measured_per_mm2, region.required_per_mm2, region.priority)
        yield "numbers", np.array(numbers).tobytes()
        for loop in (*region.outline_mm, region.centroid_mm, region.normal, region.point_rows):
            yield "of region", _bytes(loop)


def _areas(reference: ReferenceCoverage) -> bytes:
    return np.array([reference.area_mm2, reference.touched_mm2, reference.good_mm2]).tobytes()


def _bytes(values: "np.ndarray[tuple[int, ...], np.dtype[np.generic]]") -> bytes:
    """The values in one layout on every machine; all NaN are one."""
    if values.dtype.kind == "f":
        values = np.where(np.isnan(values), np.float64(np.nan), values.astype(np.float64))
    return np.ascontiguousarray(values.astype(values.dtype.newbyteorder("<"))).tobytes()
