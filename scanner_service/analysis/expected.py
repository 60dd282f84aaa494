"""What the density should be: spacing of the scanlines on the surface and the count it gives; judges nothing."""

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.snapshot import Int32Array, MapSnapshot, Unreliable


def surface_spacing_mm(snapshot: MapSnapshot, rows: Int32Array, max_radius_mm: float) -> Float64Array:
    """Spacing (m,) of the scanlines on the surface at the rows (m,), in mm; NaN where it is not known.

    With a reliable normal n, laser planes of unit normal m displaced by the line spacing along the unit travel t cut
    the surface |t.m| / sqrt(1 - (n.m)^2) line spacings apart (Fig. 6.4d of the chapter). Where there is no normal, the
    distance to the nearest point of another scanline is measured, unknown beyond `max_radius_mm`: in a single line
    the fitted plane is the laser plane, and its normal tells nothing.
    """
    lines, of = snapshot.lines, snapshot.line[rows]
    m, t = lines.plane_normal[of], lines.travel[of]
    advance = np.abs(np.einsum("ij,ij->i", t, m))
    tilt = np.einsum("ij,ij->i", snapshot.normals[rows], m)
    with np.errstate(divide="ignore", invalid="ignore"):
        spacing: Float64Array = lines.line_spacing_mm[of] * advance / np.sqrt(np.maximum(1.0 - tilt * tilt, 0.0))
    spacing[~np.isfinite(spacing)] = np.nan
    unknown = np.flatnonzero(np.isnan(spacing))
    if len(unknown):
        spacing[unknown] = _measured_spacing_mm(snapshot, rows[unknown], max_radius_mm)
    return spacing


def _measured_spacing_mm(snapshot: MapSnapshot, rows: Int32Array, max_radius_mm: float) -> Float64Array:
    """Distance (m,) from each row to the nearest counted point of another scanline, NaN beyond the radius."""
    counted = np.flatnonzero(snapshot.unreliable != Unreliable.NOT_COUNTED)
    found = np.full(len(rows), np.nan)
    if not len(counted):
        return found
    tree = cKDTree(snapshot.points_mm[counted])
    near = tree.query_ball_point(snapshot.points_mm[rows], max_radius_mm)
    for i, candidates in enumerate(near):
        others = counted[np.asarray(candidates, dtype=np.int64)]
        others = others[snapshot.line[others] != snapshot.line[rows[i]]]
        if len(others):
            offset = snapshot.points_mm[others] - snapshot.points_mm[rows[i]]
            found[i] = np.sqrt((offset * offset).sum(axis=1).min())
    return found


def expected_density_per_mm2(surface_spacing: Float64Array, point_spacing_mm: Float64Array) -> Float64Array:
    """1 / (spacing on the surface * point spacing): what ranks bad places, since Eq. 6.4 saturates there."""
    return 1.0 / (surface_spacing * point_spacing_mm)


def expected_neighbours(
    radius_mm: Float64Array, surface_spacing: Float64Array, point_spacing_mm: Float64Array
) -> Float64Array:
    """Np of evenly spaced scanlines: the sum over |j| spacing < r of 2 sqrt(r^2 - (j spacing)^2) / point spacing.

    Scanlines are not random points, so 1 / sqrt(Np) is not their counting error. All arrays (m,); NaN where unknown.
    """
    total = np.full(len(radius_mm), np.nan)
    known = np.isfinite(surface_spacing) & np.isfinite(point_spacing_mm) & (surface_spacing > 0)
    if not known.any():
        return total
    r, spacing = radius_mm[known], surface_spacing[known]
    j = np.arange(int(np.ceil((r / spacing).max())) + 1)[:, None]
    chord = 2.0 * np.sqrt(np.maximum(r * r - (j * spacing) ** 2, 0.0))
    total[known] = (chord[0] + 2.0 * chord[1:].sum(axis=0)) / point_spacing_mm[known]
    return total
