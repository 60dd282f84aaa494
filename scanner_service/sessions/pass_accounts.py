"""What became of the lines of each pass, from the wire to the disk, as one balance; knows no session and no device.

lines:  sent = stored + under way + lost, by reason
chunks: sent = stored + lost, by reason (up to the session's door, where a line has no chunks any more)
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from drivers.tally import PassTally
from scanner_service.analysis.passes import PassKey

SERVICE_ENDED = "service_ended"
"""The reason of lines that were under way when the service ended without having had the time to store them."""

_REPEATED = "repeated"


@dataclass(slots=True)
class LineFates:
    """What became of the lines of one pass that reached the session; `partial` of the stored ones lack a piece."""

    received: int = 0
    pending: int = 0
    stored: int = 0
    partial: int = 0
    duplicates: int = 0
    lost: "Counter[str]" = field(default_factory=Counter)


@dataclass(frozen=True, slots=True)
class PassAccount:
    """One pass. `chunks` is None where nothing came in chunks; `duplicates` are lines that came twice: no loss."""

    sent: int = 0
    stored: int = 0
    partial: int = 0
    under_way: int = 0
    duplicates: int = 0
    lost: Mapping[str, int] = field(default_factory=dict)
    chunks: Mapping[str, Any] | None = None

    @property
    def balances(self) -> bool:
        """True when no line, and no chunk, is unaccounted for."""
        lines = self.sent == self.stored + self.under_way + sum(self.lost.values())
        chunks = self.chunks
        return lines and (chunks is None or chunks["sent"] == chunks["stored"] + sum(chunks["lost"].values()))

    def __add__(self, other: "PassAccount") -> "PassAccount":
        lost = Counter(self.lost)
        lost.update(other.lost)
        return PassAccount(
            self.sent + other.sent,
            self.stored + other.stored,
            self.partial + other.partial,
            self.under_way + other.under_way,
            self.duplicates + other.duplicates,
            dict(sorted(lost.items())),
            self.chunks if other.chunks is None else other.chunks,
        )

    def to_dict(self, key: PassKey) -> dict[str, Any]:
        """As it is kept in the record and shown."""
        device_id, boot_id, pass_index = key
        return {
            "device_id": device_id,
            "boot_id": boot_id,
            "pass_index": pass_index,
            "lines": {
                "sent": self.sent,
                "stored": self.stored,
                "whole": self.stored - self.partial,
                "partial": self.partial,
                "under_way": self.under_way,
                "duplicates": self.duplicates,
                "lost": dict(self.lost),
            },
            "chunks": self.chunks,
        }


def account_of(fates: LineFates, wire: PassTally | None) -> PassAccount:
    """The account of a pass: what reached the session, and what the driver says of the wire before it."""
    lost = Counter(fates.lost)
    if wire is None:
        return PassAccount(
            fates.received - fates.duplicates,
            fates.stored,
            fates.partial,
            fates.pending,
            fates.duplicates,
            dict(sorted(lost.items())),
        )
    lost.update(wire.lines.lost)
    if fates.duplicates:  # numbered anew by the device, yet known: another boot under the same id
        lost[_REPEATED] += fates.duplicates
    on_the_way = wire.lines.open + wire.lines.stored - fates.received + fates.pending
    chunks = {"sent": wire.chunks.sent, "stored": wire.chunks.stored, "lost": dict(wire.chunks.lost)}
    return PassAccount(wire.lines.sent, fates.stored, fates.partial, on_the_way, 0, dict(sorted(lost.items())), chunks)


def after_a_restart(kept: PassAccount | None, stored: int, partial: int) -> PassAccount:
    """The account of a pass in a session that is opened again.

    What is stored is told by the record; of what else was sent, the account that was kept last tells. Lines that it
    had under way are in the record by now, or they ended with the service.
    """
    kept = kept or PassAccount()
    lost = Counter(kept.lost)
    sent = max(kept.sent, stored + sum(lost.values()))
    gone = sent - stored - sum(lost.values())
    if gone:
        lost[SERVICE_ENDED] += gone
    return PassAccount(sent, stored, partial, 0, kept.duplicates, dict(sorted(lost.items())), kept.chunks)


def read_accounts(kept: Iterable[Mapping[str, Any]]) -> dict[PassKey, PassAccount]:
    """The accounts that `to_dict` wrote."""
    found = {}
    for told in kept:
        lines = told["lines"]
        key = (str(told["device_id"]), int(told["boot_id"]), int(told["pass_index"]))
        found[key] = PassAccount(
            lines["sent"],
            lines["stored"],
            lines["partial"],
            lines["under_way"],
            lines["duplicates"],
            lines["lost"],
            told["chunks"],
        )
    return found
