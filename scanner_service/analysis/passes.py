"""Which passes of a map are open, where their laser planes are, and which lines stand still; knows no points."""

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from scanner_service.analysis.errors import TooManyPasses
from scanner_service.analysis.intake import QUANTUM_MM, StoredLine
from scanner_service.analysis.neighbourhood import MAX_OPEN_PASSES

PassKey = tuple[str, int, int]
"""(device id, boot id, pass index): what names a pass within a session."""

STATIONARY_SHARE = 0.25
"""Lines closer than this share of the line spacing to an accepted line of their pass are stationary."""


def pass_key(line: StoredLine) -> PassKey:
    """The pass that a line belongs to."""
    return (line.device_id, line.boot_id, line.pass_index)


@dataclass(slots=True)
class Pass:
    """One continuous motion: its number in the session, and what is known of its travel."""

    number: int
    slot: int
    heading: npt.NDArray[np.float64] | None
    is_steady: bool = True
    front_mm: float = -math.inf
    stations: dict[int, list[float]] = field(default_factory=dict)

    def stands_still_at(self, line: StoredLine) -> bool:
        """True when an accepted line of the pass lies closer than a quarter of the line spacing along the travel."""
        if not np.isfinite(line.travel).all():
            return False
        station = float(line.laser_mm @ line.travel)
        closest = STATIONARY_SHARE * line.line_spacing_mm
        bin_index = math.floor(station / closest)
        for near in (bin_index - 1, bin_index, bin_index + 1):
            if any(abs(station - other) < closest for other in self.stations.get(near, ())):
                return True
        self.stations.setdefault(bin_index, []).append(station)
        return False

    def advance(self, line: StoredLine) -> bool:
        """Take note of where the laser plane is now; True when the pass has just stopped being steady.

        A pass is steady while its planes stay parallel and move one way; only a steady pass settles points before
        it is closed.
        """
        if not self.is_steady:
            return False
        parallel = self.heading is not None and float(line.plane_normal @ self.heading) > 1.0 - 1e-9
        front = float(line.laser_mm @ self.heading) if parallel and self.heading is not None else math.nan
        if parallel and front >= self.front_mm:
            self.front_mm = front
            return False
        self.is_steady = False
        return True


class PassBook:
    """The passes of one map. A pass opens with its first line and stays known after it is closed."""

    def __init__(self) -> None:
        self._passes: dict[PassKey, Pass] = {}
        self._free = list(range(MAX_OPEN_PASSES))[::-1]
        self.heading = np.full((MAX_OPEN_PASSES, 3), np.nan)
        self.front_q = np.full(MAX_OPEN_PASSES, -np.inf)

    def enter(self, line: StoredLine) -> Pass:
        """The pass of a line, opened if it is new.

        Raises
        ------
        TooManyPasses : when MAX_OPEN_PASSES are open; close one first.
        """
        key = pass_key(line)
        known = self._passes.get(key)
        if known is not None:
            return known
        if not self._free:
            raise TooManyPasses(
                f"{MAX_OPEN_PASSES} passes are open, so pass {line.pass_index} of {line.device_id} "
                "cannot be told apart: close one first"
            )
        heading = line.plane_normal.copy() if np.isfinite(line.plane_normal).all() else None
        opened = Pass(len(self._passes), self._free.pop(), heading, is_steady=heading is not None)
        self._passes[key] = opened
        self.publish(opened, np.zeros(3))
        return opened

    def publish(self, of: Pass, origin_mm: npt.NDArray[np.float64]) -> None:
        """Write the front of an open pass where the kernels read it."""
        steady = of.is_steady and of.heading is not None and math.isfinite(of.front_mm)
        self.heading[of.slot] = of.heading if steady and of.heading is not None else np.nan
        offset = float(origin_mm @ of.heading) if of.heading is not None else 0.0
        self.front_q[of.slot] = (of.front_mm - offset) / QUANTUM_MM if steady else -np.inf

    def close(self, key: PassKey) -> Pass | None:
        """Close a pass; None when it is not open."""
        closed = self._passes.get(key)
        if closed is None or closed.slot < 0:
            return None
        slot, closed.slot = closed.slot, -1
        closed.stations.clear()
        self.heading[slot], self.front_q[slot] = np.nan, -np.inf
        self._free.append(slot)
        return Pass(closed.number, slot, closed.heading)

    def open_keys(self) -> list[PassKey]:
        """The passes that are open, in the order they were opened."""
        return [key for key, value in self._passes.items() if value.slot >= 0]
