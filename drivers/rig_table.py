"""A table of a rig file that is read key by key: every wrong or unknown key becomes one sentence; knows no rig."""

import difflib
import math
from collections.abc import Mapping
from enum import StrEnum
from typing import Any

import numpy as np

from drivers.scanline import Float64Array

Interval = tuple[float, float]
_LARGEST = 1e12  # also keeps whole numbers of a thousand digits, and NaN, out


class RigTable:
    """One table, its place in the file, and the list of problems that all tables share."""

    def __init__(self, content: Mapping[str, Any], place: str, problems: list[str]) -> None:
        self._content = content
        self._place = place
        self._problems = problems
        self._known: set[str] = set()
        self.failed = False

    def problem(self, key: str, sentence: str) -> None:
        """Note what is wrong with a key."""
        self.failed = True
        self._problems.append(f"[{self._place}] {key}: {sentence}" if self._place else f"{key}: {sentence}")

    def has(self, key: str) -> bool:
        """True when the file says something about the key."""
        return key in self._content

    def rest(self) -> Mapping[str, Any]:
        """Return everything in the table, all of it taken as known."""
        self._known.update(self._content)
        return self._content

    def finish(self) -> None:
        """Note every key that nobody asked for."""
        for key in self._content:
            if key not in self._known:
                near = difflib.get_close_matches(key, self._known, 1)
                hint = f"did you mean {near[0]}?" if near else f"known here are {', '.join(sorted(self._known))}"
                self.problem(key, f"is not known; {hint}")

    def table(self, key: str, needed: bool = False) -> "RigTable":
        """Return a table inside this one; an empty one when it is absent."""
        value = self._take(key, needed)
        place = f"{self._place}.{key}" if self._place else key
        if value is not None and not isinstance(value, dict):
            self.problem(key, f"must be a table, written [{place}]")
            value = None
        absent = needed and value is None  # said once; what it would have had to hold is not said as well
        return RigTable(value or {}, place, [] if absent else self._problems)

    def text(self, key: str, default: str = "", needed: bool = False) -> str:
        """Return a text; the default when it is absent."""
        value = self._take(key, needed)
        if value is None:
            return default
        if not isinstance(value, str) or not 0 < len(value) <= 255 or not value.isprintable():
            self.problem(key, f"must be a text of 1 to 255 characters, not {_shown(value)}")
            return default
        return value

    def choice(self, key: str, of: type[StrEnum], default: StrEnum) -> str:
        """Return one of the values of an enumeration."""
        value = self._take(key, False)
        if value is None:
            return default.value
        values = [item.value for item in of]
        if value not in values:
            self.problem(key, f"must be one of {', '.join(values)}, not {_shown(value)}")
            return default.value
        return str(value)

    def flag(self, key: str, default: bool) -> bool:
        """Return true or false."""
        value = self._take(key, False)
        if value is not None and not isinstance(value, bool):
            self.problem(key, f"must be true or false, not {_shown(value)}")
            return default
        return default if value is None else value

    def integer(self, key: str, lowest: int) -> int | None:
        """Return a whole number, None when it is absent."""
        value = self._take(key, False)
        if value is None:
            return None
        if not isinstance(value, int) or isinstance(value, bool) or not lowest <= value < 2**31:
            self.problem(key, f"must be a whole number of {lowest} or more, not {_shown(value)}")
            return None
        return value

    def number(
        self, key: str, default: float, needed: bool = False, lowest: float = -math.inf, above: float = -math.inf
    ) -> float:
        """Return a finite number."""
        value = self._take(key, needed)
        if value is None:
            return default
        if not _is_number(value) or not (lowest <= value and value > above):
            bound = (
                f" of {lowest:g} or more" if lowest > -math.inf else f" above {above:g}" if above > -math.inf else ""
            )
            self.problem(key, f"must be a number{bound}, not {_shown(value)}")
            return default
        return float(value)

    def interval(self, key: str, default: Interval, needed: bool = False, lowest: float = -math.inf) -> Interval:
        """Return [lowest, highest]."""
        value = self._take(key, needed)
        if value is None:
            return default
        if not _are_numbers(value, 2) or not lowest <= value[0] <= value[1]:
            bound = f", none below {lowest:g}" if lowest > -math.inf else ""
            self.problem(key, f"must be [lowest, highest]{bound}, not {_shown(value)}")
            return default
        return (float(value[0]), float(value[1]))

    def vector(self, key: str, default: Float64Array | None = None, needed: bool = False) -> Float64Array:
        """Return [x, y, z] as (3,)."""
        value = self._take(key, needed)
        if value is not None and _are_numbers(value, 3):
            return np.array(value, dtype=np.float64)
        if value is not None:
            self.problem(key, f"must be [x, y, z], not {_shown(value)}")
        return np.zeros(3) if default is None else default

    def matrix(self, key: str) -> Float64Array:
        """Return three rows of three numbers as (3, 3)."""
        value = self._take(key, False)
        if isinstance(value, list) and len(value) == 3 and all(_are_numbers(row, 3) for row in value):
            return np.array(value, dtype=np.float64)
        self.problem(key, f"must be three rows of three numbers, not {_shown(value)}")
        return np.eye(3)

    def box(self, key: str) -> tuple[tuple[float, float, float], tuple[float, float, float]] | None:
        """Return [[x, y, z], [x, y, z]], lowest corner first."""
        value = self._take(key, False)
        if isinstance(value, list) and len(value) == 2 and all(_are_numbers(corner, 3) for corner in value):
            low, high = (tuple(float(number) for number in corner) for corner in value)
            if all(a <= b for a, b in zip(low, high, strict=True)):
                return (low[0], low[1], low[2]), (high[0], high[1], high[2])
        self.problem(key, f"must be two corners [[x, y, z], [x, y, z]], the lowest first, not {_shown(value)}")
        return None

    def _take(self, key: str, needed: bool) -> Any:
        self._known.add(key)
        value = self._content.get(key)
        if value is None and needed:
            self.problem(key, "is missing")
        return value


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST


def _are_numbers(value: object, count: int) -> bool:
    return isinstance(value, list) and len(value) == count and all(_is_number(item) for item in value)


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
