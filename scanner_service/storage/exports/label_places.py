"""Where labels can stand without covering each other or what they name (pure); knows no picture."""

from collections.abc import Sequence

import numpy as np

from drivers.scanline import Float64Array

_DIRECTIONS = np.radians([90, 45, 135, 0, 180, -45, -135, -90])
_RINGS = 7


def pointed_at(loop: Float64Array) -> tuple[float, float]:
    """Where a label's line should end: in the middle of a closed loop (k, 2), or at its nearest vertex.

    The middle is that of the box around the loop; the vertex is taken where the middle lies outside (even-odd rule).
    """
    middle = 0.5 * (loop.min(axis=0) + loop.max(axis=0))
    start, end = loop - middle, np.roll(loop, -1, axis=0) - middle
    crosses = (start[:, 1] > 0) != (end[:, 1] > 0)
    rise = np.where(crosses, end[:, 1] - start[:, 1], 1.0)
    right = start[:, 0] - start[:, 1] * (end[:, 0] - start[:, 0]) / rise > 0
    if int((crosses & right).sum()) % 2 == 0:
        middle = loop[np.argmin((start**2).sum(axis=1))]
    return float(middle[0]), float(middle[1])


def label_places(
    anchors: Sequence[tuple[float, float]], half_sizes: Sequence[tuple[float, float]], label: tuple[float, float]
) -> list[Float64Array]:
    """Choose the middle (2,) of a label of width and height `label` for each anchor, all in one unit.

    A label stands in the middle of what it names where that is three times as large as the label, otherwise on rings
    around it: at the first place that no earlier label takes. Where all are taken it stands in the middle after all.

    Parameters
    ----------
    anchors : middle of each named thing.
    half_sizes : half its width and height.
    """
    size = np.array(label)
    taken: list[Float64Array] = []
    for anchor, half in zip(anchors, half_sizes, strict=True):
        middle = np.array(anchor)
        inside = (2 * np.array(half) >= 3 * size).all()
        places = [middle] if inside else []
        for ring in range(_RINGS):
            away = np.minimum(half, 2 * size) + (0.75 + 0.6 * ring) * size
            places += [middle + away * (np.cos(angle), np.sin(angle)) for angle in _DIRECTIONS]
        free = (place for place in places if not any((np.abs(place - other) < 1.05 * size).all() for other in taken))
        taken.append(next(free, middle))
    return taken
