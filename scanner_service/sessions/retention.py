"""Which sessions are deleted by themselves, and when: age and a disk budget; deletes nothing, knows no clock.

Only sessions that are over and that nobody has open are ever chosen, the oldest first. Without a limit nothing is.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta

OVER = ("stopped", "failed", "interrupted")


@dataclass(frozen=True, slots=True)
class Retention:
    """How long sessions are kept, and how many bytes their lines may take; None: without limit."""

    keep_days: float | None = None
    budget_bytes: int | None = None

    def __post_init__(self) -> None:
        if self.keep_days is not None and not self.keep_days > 0:
            raise ValueError(f"sessions are kept for more than 0 days, not {self.keep_days}")
        if self.budget_bytes is not None and self.budget_bytes <= 0:
            raise ValueError(f"a disk budget must be greater than 0 bytes, not {self.budget_bytes}")

    @property
    def is_unlimited(self) -> bool:
        """True when nothing is ever deleted."""
        return self.keep_days is None and self.budget_bytes is None


@dataclass(frozen=True, slots=True)
class Kept:
    """A session as the rule sees it."""

    session_id: str
    created: datetime
    size_bytes: int
    may_go: bool


@dataclass(frozen=True, slots=True)
class Choice:
    """What is to be deleted, oldest first, with the reason; and the bytes by which the budget is exceeded even then."""

    deleted: tuple[tuple[str, str], ...]
    over_bytes: int


def choose(retention: Retention, sessions: Iterable[Kept], now: datetime) -> Choice:
    """What the rule deletes now."""
    kept = sorted(sessions, key=lambda session: (session.created, session.session_id))
    deleted: list[tuple[str, str]] = []
    if retention.keep_days is not None:
        oldest = now - timedelta(days=retention.keep_days)
        gone = [session for session in kept if session.may_go and session.created < oldest]
        deleted += [(session.session_id, f"older than {retention.keep_days:g} days") for session in gone]
        kept = [session for session in kept if session not in gone]
    over_bytes = 0
    if retention.budget_bytes is not None:
        over_bytes = sum(session.size_bytes for session in kept) - retention.budget_bytes
        for session in kept:
            if over_bytes <= 0:
                break
            if session.may_go:
                deleted.append((session.session_id, "the disk budget was exceeded"))
                over_bytes -= session.size_bytes
    return Choice(tuple(deleted), max(0, over_bytes))
