"""The live stream's binary messages, byte by byte as `docs/live-stream.md` has them; knows no socket."""

import struct

import numpy as np
import numpy.typing as npt

from scanner_service.analysis.snapshot import Unreliable
from scanner_service.sessions.updates import Update

MAGIC = b"SLV1"
KIND_POINTS = 1
FLAG_FULL = 1
HEADER = struct.Struct("<4sHHQQIIII")
MAX_POINTS = 50_000
"""Points in one message at the most, so that a slow client is never handed one huge one."""


def state_bits(update: Update) -> npt.NDArray[np.uint32]:
    """(m,) uint32: reliable, settled, isolated, rescan, not counted; then the two reasons."""
    points, verdict = update.points, update.verdict
    not_counted = points.unreliable == Unreliable.NOT_COUNTED
    bits = np.zeros(len(update.rows), dtype=np.uint32)
    for shift, flag in enumerate((points.reliable, points.settled, points.isolated, verdict.rescan, not_counted)):
        bits |= flag.astype(np.uint32) << np.uint32(shift)
    bits |= points.unreliable.astype(np.uint32) << np.uint32(8)
    bits |= verdict.reason.astype(np.uint32) << np.uint32(16)
    return bits


def point_messages(update: Update) -> list[bytes]:
    """The update as one or more messages of at most MAX_POINTS points; only the first can say "forget what you have".

    All but the last carry the version the update is based on, so that a client that misses the rest asks again.
    """
    points = update.points
    xyz = (points.points_mm - points.origin_mm).astype("<f4")
    density = points.density_per_mm2.astype("<f4")
    normal = points.normals.astype("<f4")
    state = state_bits(update).astype("<u4")
    rows = update.rows.astype("<u4")
    starts = range(0, max(1, len(rows)), MAX_POINTS)
    messages = []
    for start in starts:
        part = slice(start, start + MAX_POINTS)
        is_last = start + MAX_POINTS >= len(rows)
        header = HEADER.pack(
            MAGIC,
            KIND_POINTS,
            FLAG_FULL if update.is_full and start == 0 else 0,
            update.version if is_last else update.based_on,
            update.based_on,
            len(rows[part]),
            update.skipped,
            update.total,
            0,
        )
        arrays = (rows[part], xyz[part], density[part], normal[part], state[part])
        messages.append(header + b"".join(array.tobytes() for array in arrays))
    return messages
