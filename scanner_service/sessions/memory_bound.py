"""How many points an export may hold at once in the memory that it may take; exports nothing and allocates nothing."""

from pathlib import Path

FIXED_BYTES = 300 << 20
"""What the program takes without any point."""

BYTES_A_POINT = 760
"""What a point takes at the worst moment: while the whole map is judged. In slabs it is about 150."""

MOST_POINTS, LEAST_POINTS = 10_000_000, 200_000
_MEMINFO = Path("/proc/meminfo")


def points_at_once(memory_bytes: int | None = None) -> int:
    """The points that fit into `memory_bytes`; without a figure into half of what is free now, at most 10 million."""
    if memory_bytes is None:
        free_bytes = available_bytes()
        if free_bytes is None:
            return MOST_POINTS
        return min(points_at_once(free_bytes // 2), MOST_POINTS)
    return max((memory_bytes - FIXED_BYTES) // BYTES_A_POINT, LEAST_POINTS)


def available_bytes(meminfo: Path = _MEMINFO) -> int | None:
    """Memory that programs can still have, as the system says; None where it does not."""
    try:
        for line in meminfo.read_text("ascii").splitlines():
            name, _, value = line.partition(":")
            if name == "MemAvailable":
                return int(value.split()[0]) << 10
    except (OSError, ValueError, IndexError):
        return None
    return None
