"""Points on their way out, a block at a time, so that no export needs memory of a scan's size; knows no file format."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.analysis.snapshot import Int32Array, MapSnapshot, UInt8Array

Int64Array = npt.NDArray[np.int64]
BLOCK_POINTS = 1 << 16
OnPoints = Callable[[int], object]


@dataclass(frozen=True, slots=True)
class PointBlock:
    """Some points of a map and the verdict on each, `rescan` and `reason` (k,); None where nothing was judged."""

    points: MapSnapshot
    rescan: BoolArray | None
    reason: UInt8Array | None

    def __len__(self) -> int:
        return len(self.points)

    @property
    def xyz_q(self) -> Int64Array:
        """(k, 3) the stored coordinates: whole multiples of 2**-13 mm from the origin."""
        return np.rint((self.points.points_mm - self.points.origin_mm) / QUANTUM_MM).astype(np.int64)

    @property
    def normals(self) -> Float64Array:
        """(k, 3) unit normals, NaN where not reliable."""
        return np.where(self.points.reliable[:, None], self.points.normals, np.nan)

    @property
    def laser_mm(self) -> Float64Array:
        """(k, 3) laser position of each point's own scanline."""
        return self.points.lines.laser_mm[self.points.line]

    def of_line(self, name: str) -> npt.NDArray[np.generic]:
        """(k, ...) a column of the line table, for each point that of its own scanline."""
        column: npt.NDArray[np.generic] = getattr(self.points.lines, name)
        return column[self.points.line]


@dataclass(frozen=True, slots=True)
class PointStream:
    """All points of an export, to be read once from `blocks()`, each a block of moderate size.

    `total` is how many there will be, `low_q` and `high_q` (3,) the box of their stored coordinates, in quanta from
    `origin_mm`; both zero without points. `is_judged` tells whether blocks carry a verdict.
    """

    total: int
    origin_mm: Float64Array
    low_q: Int64Array
    high_q: Int64Array
    is_judged: bool
    blocks: Callable[[], Iterator[PointBlock]]

    def told(self, on_points: OnPoints) -> "PointStream":
        """The same stream, which tells after each block how many points have gone through."""

        def blocks() -> Iterator[PointBlock]:
            done = 0
            for block in self.blocks():
                yield block
                done += len(block)
                on_points(done)

        return replace(self, blocks=blocks)


def stream_of(snapshot: MapSnapshot, rescan: BoolArray | None = None, reason: UInt8Array | None = None) -> PointStream:
    """The points of a snapshot in its order; `rescan` and `reason` (n,) as the verdict has them.

    Raises
    ------
    ValueError : a verdict that has not one value a point.
    """
    total = len(snapshot)
    for name, values in (("rescan", rescan), ("reason", reason)):
        if values is not None and values.shape != (total,):
            raise ValueError(f"{name} must have shape ({total},), not {values.shape}")

    def blocks() -> Iterator[PointBlock]:
        for start in range(0, total, BLOCK_POINTS):
            part = slice(start, min(start + BLOCK_POINTS, total))
            yield PointBlock(
                rows_of(snapshot, part),
                None if rescan is None else rescan[part],
                None if reason is None else reason[part],
            )

    low_q, high_q = box_q(snapshot)
    return PointStream(total, snapshot.origin_mm, low_q, high_q, rescan is not None, blocks)


def box_q(snapshot: MapSnapshot) -> tuple[Int64Array, Int64Array]:
    """Lowest and highest stored coordinates (3,) in quanta from the origin; zeros without points."""
    if not len(snapshot):
        return np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64)
    low, high = snapshot.points_mm.min(axis=0), snapshot.points_mm.max(axis=0)
    low_q, high_q = (np.rint((end - snapshot.origin_mm) / QUANTUM_MM).astype(np.int64) for end in (low, high))
    return low_q, high_q


def rows_of(snapshot: MapSnapshot, part: "slice | Int32Array | BoolArray") -> MapSnapshot:
    """Some rows of a snapshot, with the whole line table."""
    columns: dict[str, Any] = {
        item.name: value[part]
        for item in fields(snapshot)
        if isinstance(value := getattr(snapshot, item.name), np.ndarray) and item.name != "origin_mm"
    }
    return replace(snapshot, **columns)
