"""How many points an export may hold at once in the memory that it may take; exports nothing and allocates nothing."""

from pathlib import Path

FIXED_BYTES = 300 << 20
"""What the program takes without any point."""

BYTES_A_POINT = 760
"""What a point takes at the worst moment: while the whole map is judged. In slabs it is about 150."""

MOST_POINTS, LEAST_POINTS = 10_000_000, 200_000
_MEMINFO = Path("/proc/meminfo")
_OWN_GROUP, _GROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")


def points_at_once(memory_bytes: int | None = None) -> int:
    """The points that fit into `memory_bytes`; without a figure into half of what is free now, at most 10 million."""
    if memory_bytes is None:
        known = [free for free in (available_bytes(), left_to_group_bytes()) if free is not None]
        if not known:
            return MOST_POINTS
        return min(points_at_once(min(known) // 2), MOST_POINTS)
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


def left_to_group_bytes(own_group: Path = _OWN_GROUP, groups: Path = _GROUPS) -> int | None:
    """What a container or a unit still leaves to this program (control groups, version 2); None without a limit.

    Pages of files that were not used lately can be taken back, and count as free.
    """
    left = []
    try:
        name = next(row[3:] for row in own_group.read_text("utf-8").splitlines() if row.startswith("0::"))
    except (OSError, ValueError, StopIteration):
        return None
    at = groups / name.strip("/")
    for folder in (at, *at.parents):
        try:
            most = (folder / "memory.max").read_text("ascii").strip()
            used = int((folder / "memory.current").read_text("ascii"))
            told = dict(row.split() for row in (folder / "memory.stat").read_text("ascii").splitlines())
            if most != "max":
                left.append(max(0, int(most) - used + int(told.get("inactive_file", 0))))
        except (OSError, ValueError):
            pass  # the root has no limit, and older systems no such files
        if folder == groups:
            break
    return min(left, default=None)
