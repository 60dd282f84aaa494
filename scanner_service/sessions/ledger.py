"""The session's ledger: every line and every point that came in, and what became of it; knows no device and no map."""

import threading
from collections import Counter
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field, fields
from typing import Any

from drivers.tally import PassTally
from scanner_service.analysis.intake import StoredLine
from scanner_service.analysis.map_settings import Accepted
from scanner_service.analysis.passes import PassKey
from scanner_service.sessions.pass_accounts import (
    SERVICE_ENDED,
    LineFates,
    PassAccount,
    account_of,
    after_a_restart,
    read_accounts,
)


@dataclass(slots=True)
class Ledger:
    """Three balances that hold at any moment.

    lines:  received = pending + stored + duplicates + conflicts + refused, by reason
    points: places of the lines in the map = counted + dropped, by reason + left out, by reason
    passes: sent = stored + under way + lost, by reason, for each pass of each device (`pass_accounts.py`)

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
    _fates: dict[PassKey, LineFates] = field(default_factory=dict)
    _earlier: dict[PassKey, PassAccount] = field(default_factory=dict)
    _lock: threading.Condition = field(default_factory=threading.Condition)

    def arrived(self, key: PassKey) -> None:
        """A line of a pass came in and waits for its fate."""
        with self._lock:
            self.received += 1
            self.pending += 1
            fates = self._fates.setdefault(key, LineFates())
            fates.received += 1
            fates.pending += 1

    def decided(self, outcome: str, key: PassKey, is_partial: bool = False) -> None:
        """A line's fate: `stored`, `duplicate`, `conflict`, or the reason for which it was refused."""
        with self._lock:
            self.pending -= 1
            fates = self._fates[key]
            fates.pending -= 1
            if outcome == "stored":
                self.stored += 1
                fates.stored += 1
                fates.partial += is_partial
            elif outcome == "duplicate":
                self.duplicates += 1
                fates.duplicates += 1
            else:
                fates.lost[outcome] += 1
                if outcome == "conflict":
                    self.conflicts += 1
                else:
                    self.refused[outcome] += 1
            if self.pending == 0:
                self._lock.notify_all()

    def wait_until_decided(self, timeout_s: float) -> bool:
        """Wait until every line that came in has its fate; False when not after `timeout_s`."""
        with self._lock:
            return self._lock.wait_for(lambda: self.pending == 0, timeout_s)

    def reopened(
        self, kept: Mapping[str, Any] | None, stored: Mapping[PassKey, int], partial: Mapping[PassKey, int]
    ) -> None:
        """Go on from what the record holds of each pass, and from the account that was kept last, if there is one."""
        with self._lock:
            accounts = read_accounts(kept["passes"]) if kept is not None else {}
            for key in dict.fromkeys((*accounts, *stored)):
                account = after_a_restart(accounts.get(key), stored.get(key, 0), partial.get(key, 0))
                self._earlier[key] = account
                self.stored += account.stored
                if account.lost.get(SERVICE_ENDED):
                    self.refused[SERVICE_ENDED] += account.lost[SERVICE_ENDED]
            if kept is not None:
                lines = kept["lines"]
                self.duplicates, self.conflicts = lines["duplicates"], lines["conflicts"]
                earlier = {reason: count for reason, count in lines["refused"].items() if reason != SERVICE_ENDED}
                self.refused.update(earlier)
            self.received = self.stored + self.duplicates + self.conflicts + sum(self.refused.values())

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

    def snapshot(self) -> "Ledger":
        """A copy as of now.

        Where there is a wire, its accounts are to be read after this: a line is counted there before it gets here, so
        that none which the copy knows can be missing in them.
        """
        with self._lock:
            held = {item.name: getattr(self, item.name) for item in fields(self) if item.name != "_lock"}
            return Ledger(**deepcopy(held))

    def passes(self, wire: Mapping[PassKey, PassTally] | None = None) -> dict[PassKey, PassAccount]:
        """The account of every pass; `wire` is the driver's own of those that came over one."""
        wire = wire or {}
        with self._lock:
            accounts = dict(self._earlier)
            for key in dict.fromkeys((*self._fates, *wire)):
                account = account_of(self._fates.get(key, LineFates()), wire.get(key))
                accounts[key] = accounts[key] + account if key in accounts else account
        return accounts

    def to_dict(
        self, device: Mapping[str, Any] | None = None, wire: Mapping[PassKey, PassTally] | None = None
    ) -> dict[str, Any]:
        """As the API, the summary and the viewer show it; `device` is the drivers' own sum of chunks and lines."""
        passes = [account.to_dict(key) for key, account in self.passes(wire).items()]
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
                "passes": passes,
                "device": dict(device) if device is not None else None,
            }
