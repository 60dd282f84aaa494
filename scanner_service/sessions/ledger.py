"""The session's ledger: every line and every point that came in, and what became of it; knows no device and no map."""

import threading
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from scanner_service.analysis.intake import StoredLine
from scanner_service.analysis.live_map import Accepted


@dataclass(slots=True)
class Ledger:
    """Two balances that hold at any moment.

    lines:  received = pending + stored + duplicates + conflicts + refused, by reason
    points: places of the lines in the map = counted + dropped, by reason + left out, by reason

    The engine writes the points and the arrivals, the record's answers come from its writer: hence the lock.
    """

    received: int = 0
    pending: int = 0
    stored: int = 0
    duplicates: int = 0
    conflicts: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    places: int = 0
    counted: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def arrived(self) -> None:
        """A line came in and waits for its fate."""
        with self._lock:
            self.received += 1
            self.pending += 1

    def decided(self, outcome: str) -> None:
        """A line's fate: `stored`, `duplicate`, `conflict`, or the reason for which it was refused."""
        with self._lock:
            self.pending -= 1
            if outcome == "stored":
                self.stored += 1
            elif outcome == "duplicate":
                self.duplicates += 1
            elif outcome == "conflict":
                self.conflicts += 1
            else:
                self.refused[outcome] += 1

    def mapped(self, line: StoredLine, accepted: Accepted) -> None:
        """A line went into the map."""
        with self._lock:
            self.places += line.point_count
            self.dropped.update(line.dropped)
            self.counted += accepted.counted
            self.left_out.update(accepted.left_out)

    def withdrawn(self, points: int) -> None:
        """Points of a withdrawn pass were taken out of the map again."""
        with self._lock:
            self.counted -= points
            self.left_out["withdrawn"] += points

    def to_dict(self, device: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """As the API, the summary and the viewer show it; `device` is the driver's own tally of chunks and lines."""
        with self._lock:
            return {
                "lines": {
                    "received": self.received,
                    "pending": self.pending,
                    "stored": self.stored,
                    "duplicates": self.duplicates,
                    "conflicts": self.conflicts,
                    "refused": dict(sorted(self.refused.items())),
                },
                "points": {
                    "places": self.places,
                    "counted": self.counted,
                    "dropped": dict(sorted(self.dropped.items())),
                    "left_out": dict(sorted(self.left_out.items())),
                },
                "device": dict(device) if device is not None else None,
            }
