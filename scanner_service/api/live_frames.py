"""The live stream's binary messages, byte by byte as `docs/live-stream.md` has them; knows no socket."""

import struct

import numpy as np
import numpy.typing as npt

from scanner_service.analysis.snapshot import Unreliable
from scanner_service.sessions.updates import PointPage

MAGIC = b"SLV1"
KIND_POINTS = 1
FLAG_FULL = 1
HEADER = struct.Struct("<4sHHQQIIII")
MAX_POINTS = 50_000
"""Points in one message at the most; a page is read when there is credit for it, so a slow client costs little."""


def state_bits(page: PointPage) -> npt.NDArray[np.uint32]:
    """(m,) uint32: reliable, settled, isolated, rescan, not counted; then the two reasons."""
    points, verdict = page.points, page.verdict
    not_counted = points.unreliable == Unreliable.NOT_COUNTED
    bits = np.zeros(len(page.rows), dtype=np.uint32)
    for shift, flag in enumerate((points.reliable, points.settled, points.isolated, verdict.rescan, not_counted)):
        bits |= flag.astype(np.uint32) << np.uint32(shift)
    bits |= points.unreliable.astype(np.uint32) << np.uint32(8)
    bits |= verdict.reason.astype(np.uint32) << np.uint32(16)
    return bits


def point_message(page: PointPage) -> bytes:
    """A page of changed points as one message; only the first of a full update can say "forget what you have".

    All but the last carry the version the update is based on, so that a client that misses the rest asks again.
    """
    points, changes = page.points, page.changes
    header = HEADER.pack(
        MAGIC,
        KIND_POINTS,
        FLAG_FULL if changes.rows is None and page.is_first else 0,
        changes.version if page.is_last else changes.based_on,
        changes.based_on,
        len(page.rows),
        changes.skipped,
        changes.total,
        0,
    )
    arrays = (
        page.rows.astype("<u4", copy=False),
        points.xyz_mm.astype("<f4", copy=False),
        points.density_per_mm2.astype("<f4", copy=False),
        points.normals.astype("<f4", copy=False),
        state_bits(page).astype("<u4", copy=False),
    )
    return b"".join((header, *(array.data for array in arrays)))
