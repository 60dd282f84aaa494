"""What the drivers of a session counted: those of the passes that were, and the one that is; knows no session."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from drivers.tally import PassTally
from scanner_service.analysis.passes import PassKey
from scanner_service.sessions.source import OnAWire, Source

_UNITS = ("_mm", "_s", "_hz", "_rad", "_deg", "_per_mm2", "_id", "_index")
"""How names of figures end that are no counts."""


@dataclass(frozen=True, slots=True)
class Wires:
    """The source that is read, and the accounts of those before it, which are gone."""

    source: Source
    earlier_passes: Mapping[PassKey, PassTally] = field(default_factory=dict)
    earlier_account: Mapping[str, Any] | None = None

    def followed_by(self, source: Source) -> "Wires":
        """The same, with another source from here on."""
        return Wires(source, self.passes(), self.account())

    def passes(self) -> dict[PassKey, PassTally]:
        """The account of each pass that came over a wire."""
        found, told = dict(self.earlier_passes), self.source.pass_tallies() if isinstance(self.source, OnAWire) else {}
        for key, tally in told.items():
            found[key] = found[key] + tally if key in found else tally
        return found

    def account(self) -> dict[str, Any] | None:
        """The sum over all sources; None when none of them had a wire."""
        return joined(self.earlier_account, self.source.tally())


def joined(earlier: Mapping[str, Any] | None, later: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Two accounts as one: counts are added, the smallest and largest stay so, any other figure is the later one's.

    A count is an integer whose name tells no unit: a spacing of 1 mm is none, though it may be written as one.
    """
    if earlier is None or later is None:
        only = earlier if later is None else later
        return None if only is None else dict(only)
    return {name: _one(name, earlier.get(name), later.get(name)) for name in dict.fromkeys((*earlier, *later))}


def _one(name: str, earlier: Any, later: Any) -> Any:
    if earlier is None or later is None:
        return earlier if later is None else later
    if isinstance(earlier, Mapping) and isinstance(later, Mapping):
        return joined(earlier, later)
    if name.startswith("smallest_"):
        return min(earlier, later)
    if name.startswith("largest_"):
        return max(earlier, later)
    are_counts = all(isinstance(value, int) and not isinstance(value, bool) for value in (earlier, later))
    return earlier + later if are_counts and not name.endswith(_UNITS) else later
