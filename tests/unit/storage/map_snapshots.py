"""Snapshots of a map made by hand: a tilted plate with unreliable and unsettled corners."""

import numpy as np

from scanner_service.analysis.snapshot import LineTable, MapSnapshot, Unreliable

QUANTUM_MM = 2.0**-13


def plate(lines=12, points=15, spacing_mm=0.25, seed=1) -> MapSnapshot:
    """A plate of `lines` x `points`; every third point of line 1 is unreliable, line 2 is not settled."""
    rng = np.random.default_rng(seed)
    n = lines * points
    y, x = np.meshgrid(np.arange(lines) * spacing_mm, np.arange(points) * 0.2, indexing="ij")
    xyz_q = np.rint(np.column_stack([x.ravel(), y.ravel(), 0.1 * x.ravel()]) / QUANTUM_MM)
    origin = np.array([100.0, -7.5, 0.25])
    line = np.repeat(np.arange(lines), points).astype(np.int32)
    place = np.tile(np.arange(points), lines).astype(np.int32)
    neighbours = rng.integers(1, 40, n).astype(np.int32)
    radius = rng.uniform(0.3, 0.6, n)
    unreliable = np.where((line == 1) & (place % 3 == 0), Unreliable.SINGLE_LINE, 0).astype(np.uint8)
    normals = rng.normal(size=(n, 3)) + np.array([0, 0, 9])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    normals[unreliable > 0] = np.nan
    along_y = np.tile([0.0, 1.0, 0.0], (lines, 1))
    table = LineTable(
        device_ids=("A",),
        device=np.zeros(lines, np.int32),
        boot_id=np.zeros(lines, np.int64),
        pass_number=np.zeros(lines, np.int32),
        line_index=np.arange(lines),
        point_count=np.full(lines, points, np.int32),
        laser_mm=rng.normal(size=(lines, 3)) + np.array([0, 0, 300]),
        plane_normal=along_y,
        travel=along_y.copy(),
        position_mm=np.arange(lines) * spacing_mm,
        line_spacing_mm=np.full(lines, spacing_mm),
        step_mm=np.full(lines, spacing_mm),
        point_spacing_mm=np.full(lines, 0.2),
        stationary=np.zeros(lines, bool),
    )
    return MapSnapshot(
        version=1,
        origin_mm=origin,
        points_mm=origin + xyz_q * QUANTUM_MM,
        line=line,
        index=place,
        radius_mm=radius,
        radius_rule=np.zeros(n, np.uint8),
        neighbours=neighbours,
        same_side=neighbours,
        density_per_mm2=neighbours / (np.pi * radius**2),
        normals=normals,
        unreliable=unreliable,
        settled=line != 2,
        isolated=np.zeros(n, bool),
        offset=np.zeros(n),
        residual_mm=np.zeros(n),
        normal_error_rad=np.zeros(n),
        lines=table,
    )
