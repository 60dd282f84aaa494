"""The global radius of a growing cloud: whom it samples and when it is estimated anew; knows no neighbourhoods."""

import numpy as np

from drivers.scanline import Float64Array
from scanner_service.analysis.intake import StoredLine
from scanner_service.analysis.radius import sample_rows
from scanner_service.analysis.snapshot import Int32Array

FIRST_ESTIMATE = 2000
"""Points after which the radius is estimated for the first time; until then Eq. 6.3 stands in."""


class GlobalRadius:
    """One radius for a whole cloud: the median of the flexible radii of a repeatable 1 % sample (chapter, 6.2.2).

    It is estimated at the border of a line whenever the number of points has doubled.
    """

    def __init__(self) -> None:
        self.radius_mm: float | None = None
        self._rows: list[Int32Array] = []
        self._next = FIRST_ESTIMATE

    def wants_estimate(self, line: StoredLine, first: int, last: int) -> bool:
        """Sample a line whose points are the rows from `first` to `last`; True when it is time for an estimate."""
        numbers = np.full(len(line.index), line.line_index, dtype=np.int64)
        chosen = sample_rows(line.device_id, line.boot_id, numbers, line.index.astype(np.int64))
        self._rows.append((first + chosen).astype(np.int32))
        return last >= self._next

    def sample(self) -> Int32Array:
        """Rows of all points in the sample."""
        self._rows = [np.concatenate(self._rows)]
        return self._rows[0]

    def settle_on(self, radii_mm: Float64Array, used: int) -> float | None:
        """Take the median of the sample's radii; None, and a later try, while the sample is empty."""
        if not len(radii_mm):
            self._next = used + FIRST_ESTIMATE
            return None
        self._next = 2 * used
        self.radius_mm = float(np.median(radii_mm))
        return self.radius_mm
