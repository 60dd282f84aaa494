"""Which passes of a map are open, where their laser planes are, and which lines stand still; knows no points."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from scanner_service.analysis.errors import TooManyPasses
from scanner_service.analysis.intake import QUANTUM_MM, StoredLine
from scanner_service.analysis.points import MAX_OPEN_PASSES

PassKey = tuple[str, int, int]
"""(device id, boot id, pass index): what names a pass within a session."""

STATIONARY_SHARE = 0.25
"""Lines closer than this share of the line spacing to an accepted line of their pass are stationary."""


def pass_key(line: StoredLine) -> PassKey:
    """The pass that a line belongs to."""
    return (line.device_id, line.boot_id, line.pass_index)


@dataclass(slots=True)
class Pass:
    """One continuous motion: its number in the session, and what is known of its travel.

    `normal` is the unit normal of its laser planes, None when unknown; `direction` +1 or -1 says which way along it
    they go, 0 before there are two different ones; `front_mm` how far along the normal the latest plane lies.
    """

    number: int
    slot: int
    normal: npt.NDArray[np.float64] | None
    is_steady: bool = True
    direction: int = 0
    front_mm: float = math.nan
    stations: dict[int, list[float]] = field(default_factory=dict)
    is_withdrawn: bool = False
    first: StoredLine | None = None
    turns: bool = False

    def stands_still_at(self, line: StoredLine) -> bool:
        """True when an accepted line of the pass lies closer than a quarter of the line spacing along the travel."""
        if not np.isfinite(line.travel).all() or (self.turns and not math.isfinite(line.position_mm)):
            return False
        closest = STATIONARY_SHARE * line.line_spacing_mm
        if self.first is None:
            self.first = line
        elif not self.turns and _turned(self.first, line):
            self.turns = True
            self.stations = {math.floor(self.first.position_mm / closest): [self.first.position_mm]}
        # On a turntable the laser never moves along the tangent it travels by; there the stage position tells.
        station = line.position_mm if self.turns else float(line.laser_mm @ line.travel)
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
        if not self.is_steady or self.normal is None:
            return False
        parallel = float(line.plane_normal @ self.normal) > 1.0 - 1e-9
        front_mm = float(line.laser_mm @ self.normal)
        moved = 0.0 if math.isnan(self.front_mm) else front_mm - self.front_mm
        if self.direction == 0 and moved != 0.0:
            self.direction = 1 if moved > 0 else -1
        self.front_mm = front_mm
        self.is_steady = parallel and moved * self.direction >= 0.0
        return not self.is_steady


def _turned(first: StoredLine, line: StoredLine) -> bool:
    """True when the travel has turned between two lines, and both tell their stage positions."""
    known = math.isfinite(first.position_mm) and math.isfinite(line.position_mm)
    return known and float(line.travel @ first.travel) < 1.0 - 1e-9


class PassBook:
    """The passes of one map. A pass opens with its first line and stays known after it is closed."""

    def __init__(self) -> None:
        self._passes: dict[PassKey, Pass] = {}
        self._free = list(range(MAX_OPEN_PASSES))[::-1]
        self.heading = np.full((MAX_OPEN_PASSES, 3), np.nan)
        self.front_q = np.full(MAX_OPEN_PASSES, -np.inf)
        self.open_bits = np.zeros(1, dtype=np.uint8)

    def check_room(self, line: StoredLine) -> None:
        """Raise TooManyPasses when the line would open a pass more than MAX_OPEN_PASSES."""
        if pass_key(line) not in self._passes and not self._free:
            raise TooManyPasses(
                f"{MAX_OPEN_PASSES} passes are open, so pass {line.pass_index} of {line.device_id} "
                "cannot be told apart: close one first"
            )

    def enter(self, line: StoredLine) -> Pass:
        """The pass of a line, opened if it is new; raises TooManyPasses as `check_room` does."""
        self.check_room(line)
        key = pass_key(line)
        known = self._passes.get(key)
        if known is not None:
            return known
        normal = line.plane_normal.copy() if np.isfinite(line.plane_normal).all() else None
        opened = Pass(len(self._passes), self._free.pop(), normal, is_steady=normal is not None)
        self._passes[key] = opened
        self._publish_unknown(opened.slot)
        self.open_bits |= np.uint8(1 << opened.slot)
        return opened

    def publish(self, of: Pass, origin_mm: npt.NDArray[np.float64]) -> None:
        """Write the front of an open pass where the kernels read it."""
        if not of.is_steady or of.normal is None or of.direction == 0:
            self._publish_unknown(of.slot)
            return
        self.heading[of.slot] = of.direction * of.normal
        self.front_q[of.slot] = of.direction * (of.front_mm - float(origin_mm @ of.normal)) / QUANTUM_MM

    def _publish_unknown(self, slot: int) -> None:
        self.heading[slot], self.front_q[slot] = np.nan, -np.inf

    def close(self, key: PassKey) -> Pass | None:
        """Close a pass; None when it is not open."""
        closed = self._passes.get(key)
        if closed is None or closed.slot < 0:
            return None
        slot, closed.slot = closed.slot, -1
        closed.stations.clear()
        closed.first = None
        self._publish_unknown(slot)
        self.open_bits &= ~np.uint8(1 << slot)
        self._free.append(slot)
        return Pass(closed.number, slot, closed.normal)

    def withdraw(self, key: PassKey) -> int | None:
        """Mark a closed pass as withdrawn; its number, or None when it is unknown or was withdrawn before."""
        known = self._passes.get(key)
        if known is None or known.is_withdrawn:
            return None
        known.is_withdrawn = True
        return known.number

    def keys_of(self, numbers: Iterable[int]) -> list[PassKey]:
        """The names of passes that are known by their number in the session."""
        keys = list(self._passes)
        return [keys[number] for number in numbers]

    def is_in_force(self, key: PassKey) -> bool:
        """True for a pass that is known and not withdrawn."""
        known = self._passes.get(key)
        return known is not None and not known.is_withdrawn

    def open_keys(self) -> list[PassKey]:
        """The passes that are open, in the order they were opened."""
        return [key for key, value in self._passes.items() if value.slot >= 0]
