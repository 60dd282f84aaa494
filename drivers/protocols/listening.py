"""Time in which a program has listened, as against time that has passed; knows no clock and waits for nothing.

A process that was stopped for a minute, by a debugger or a busy machine, has not listened for a minute: what was said
meanwhile lies in the port's buffer, and its reader has not had its turn yet.
"""

LISTENED_S = 0.25
"""The most that counts between two looks at the clock."""


def listened_s(before_s: float, now_s: float) -> float:
    """Return how much of the time between two looks at the clock counts as listened."""
    return min(max(0.0, now_s - before_s), LISTENED_S)
