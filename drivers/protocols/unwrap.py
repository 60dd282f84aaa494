"""Counters that wrap, continued beyond; knows nothing of what they count."""

_SPAN = 1 << 32


def unwrap(reference: int, value: int, span: int) -> int:
    """Return the integer congruent to `value` modulo `span` that lies nearest to `reference`."""
    return reference + (value - reference + span // 2) % span - span // 2


def unwrap_u32(reference: int, value: int) -> int:
    """Return the integer congruent to `value` modulo 2**32 that lies nearest to `reference`.

    The result lies in [reference - 2**31, reference + 2**31), and may be negative: a counter older than the start.
    """
    return unwrap(reference, value, _SPAN)


def increase_u32(before: int, after: int) -> int:
    """Return by how much a u32 counter grew, 0 to 2**32 - 1, one wrap allowed."""
    return (after - before) % _SPAN
