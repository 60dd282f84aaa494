"""How much of a disc the border of a part leaves, told from the neighbourhood's centroid; knows no scanlines.

A disc of radius r around a point at distance u·r from a straight border loses the segment beyond the border:

    lost area  A(u) = arccos(u) - u·sqrt(1 - u²)                (in r²)
    share      S(u) = 1 - A(u) / π                              1 in the middle, 1/2 on the border
    offset     e(u) = (2/3)·(1 - u²)^(3/2) / (π - A(u))         0 in the middle, 4/(3π) = 0.424 on the border

because the segment's first moment is (2/3)(1 - u²)^(3/2) and the whole disc's is zero. e falls as u grows, so the
offset tells the share. Beyond 0.424 (a corner) the point stands at the tip of a wedge of half angle α:
e = (2/3)·sin(α)/α, S = α/π, which meets the first branch at α = π/2. A right-angled corner has e = 0.6, S = 1/4.
"""

import numpy as np

from drivers.scanline import Float64Array

STRAIGHT_OFFSET = 4.0 / (3.0 * np.pi)
LEAST_OFFSET = 0.12  # scanlines are discrete: in the middle of a sound surface the centroid wanders this far
LEAST_SHARE = 0.25  # sharper corners than a right angle are treated as a right angle


def _table() -> tuple[Float64Array, Float64Array]:
    """Offsets (rising) and the share of the disc that belongs to each."""
    u = np.linspace(1.0, 0.0, 400)
    lost = np.arccos(u) - u * np.sqrt(1.0 - u * u)
    straight = (2.0 / 3.0) * (1.0 - u * u) ** 1.5 / (np.pi - lost)
    alpha = np.linspace(np.pi / 2, np.pi * LEAST_SHARE, 200)[1:]
    wedge = (2.0 / 3.0) * np.sin(alpha) / alpha
    return np.concatenate([straight, wedge]), np.concatenate([1.0 - lost / np.pi, alpha / np.pi])


_OFFSETS, _SHARES = _table()


def share_left(offset: Float64Array) -> Float64Array:
    """Share of the disc that lies on the part, for centroid offsets |mean - p| / r of any shape.

    Between LEAST_SHARE and 1; NaN offsets give NaN. Nothing is taken off below an offset of LEAST_OFFSET: use
    `border_aware` for densities.
    """
    return np.interp(offset, _OFFSETS, _SHARES)


def border_aware(density_per_mm2: Float64Array, offset: Float64Array) -> Float64Array:
    """Density divided by the share of the disc a border leaves; unchanged where the offset is below LEAST_OFFSET."""
    share = np.where(offset < LEAST_OFFSET, 1.0, share_left(offset))
    corrected: Float64Array = density_per_mm2 / share
    return corrected
