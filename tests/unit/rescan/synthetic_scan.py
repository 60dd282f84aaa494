"""Synthetic scans for the tests: analytic height fields under a laser fan and a camera, and a batch map of them."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from scanner_service.analysis.snapshot import LineTable, MapSnapshot, RadiusRule, Unreliable

Height = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass
class Scan:
    """Scanlines as lists of points, in the frame in which they were taken: x the line, y the travel, z height."""

    points: list[np.ndarray] = field(default_factory=list)  # (k, 3) each
    index: list[np.ndarray] = field(default_factory=list)
    line_index: list[int] = field(default_factory=list)
    pass_number: list[int] = field(default_factory=list)
    position: list[float] = field(default_factory=list)
    laser: list[np.ndarray] = field(default_factory=list)
    spacing: list[float] = field(default_factory=list)
    places: int = 0

    def without(self, lost: range) -> "Scan":
        """The same scan with the line indices in `lost` never arrived."""
        keep = [k for k, number in enumerate(self.line_index) if number not in lost]
        parts = {name: [getattr(self, name)[k] for k in keep] for name in self.__dataclass_fields__ if name != "places"}
        return Scan(**parts, places=self.places)

    def joined(self, other: "Scan") -> "Scan":
        names = [name for name in self.__dataclass_fields__ if name != "places"]
        return Scan(**{name: getattr(self, name) + getattr(other, name) for name in names}, places=self.places)


def straight_down(
    height: Height,
    x: np.ndarray,
    y: np.ndarray,
    spacing_mm: float,
    noise_mm: float = 0.0,
    seed: int = 1,
    pass_number: int = 1,
) -> Scan:
    """Parallel rays from above at every x, one line at every y; NaN heights are no returns. The laser is far above."""
    rng = np.random.default_rng(seed)
    scan = Scan(places=len(x))
    for number, station in enumerate(y):
        z = height(x, np.full_like(x, station)) + noise_mm * rng.standard_normal(len(x))
        seen = np.isfinite(z)
        scan.points.append(np.column_stack([x, np.full_like(x, station), z])[seen])
        scan.index.append(np.flatnonzero(seen))
        scan.line_index.append(number)
        scan.pass_number.append(pass_number)
        scan.position.append(float(station))
        scan.laser.append(np.array([float(x.mean()), float(station), 1e4]))
        scan.spacing.append(spacing_mm)
    return scan


def triangulated(
    height: Height,
    x: np.ndarray,
    y: np.ndarray,
    spacing_mm: float,
    standoff_mm: float = 150.0,
    camera_deg: float = 30.0,
    range_mm: tuple[float, float] = (-np.inf, np.inf),
    noise_mm: float = 0.0,
    thickness_mm: float = np.inf,
    pass_number: int = 1,
) -> Scan:
    """A fan from (mid x, y, standoff) through every x at z = 0, watched by a camera `camera_deg` off in +y.

    A dense march along each ray finds the first crossing of the height field (so the laser's shadow exists), and a
    march from there to the camera drops what the field hides (the camera's). NaN heights are bottomless;
    nothing returns from deeper than `thickness_mm` below z = 0.
    """
    rng = np.random.default_rng(5)
    scan = Scan(places=len(x))
    middle = float(x.mean())
    camera_y = standoff_mm * np.tan(np.radians(camera_deg))
    top, bottom = 25.0, -25.0
    fan, station = np.tile(x - middle, len(y)), np.repeat(y.astype(float), len(x))  # (lines * places,) each
    z, above = np.full(len(fan), np.nan), np.full(len(fan), top)
    is_open = np.arange(len(fan))  # the rays that met nothing yet
    for level in np.arange(top, bottom, -0.05):
        at = middle + fan[is_open] * (standoff_mm - level) / standoff_mm
        under = np.nan_to_num(height(at, station[is_open]), nan=-np.inf) >= level
        z[is_open[under]] = level
        is_open = is_open[~under]
        above[is_open] = level
    for _ in range(30):  # bisection to the crossing
        half = 0.5 * (above + z)
        at = middle + fan * (standoff_mm - half) / standoff_mm
        under = np.nan_to_num(height(at, station), nan=-np.inf) >= half
        z, above = np.where(under, half, z), np.where(under, above, half)
    px = middle + fan * (standoff_mm - z) / standoff_mm
    seen = np.isfinite(z) & (z >= -thickness_mm)
    for share in np.linspace(0.0, 0.2, 250)[1:]:
        qx, qy = px + share * (middle - px), station + share * camera_y
        qz = z + share * (standoff_mm - z)
        seen &= ~(np.nan_to_num(height(qx, qy), nan=-np.inf) > qz + 1e-6)
    z = z + noise_mm * rng.standard_normal(len(fan))
    seen &= (z >= range_mm[0]) & (z <= range_mm[1])
    by_line = (np.column_stack([px, station, z]).reshape(len(y), len(x), 3), seen.reshape(len(y), len(x)))
    for number, (line, line_seen) in enumerate(zip(*by_line, strict=True)):
        scan.points.append(line[line_seen])
        scan.index.append(np.flatnonzero(line_seen))
        scan.line_index.append(number)
        scan.pass_number.append(pass_number)
        scan.position.append(float(y[number]))
        scan.laser.append(np.array([middle, float(y[number]), standoff_mm]))
        scan.spacing.append(spacing_mm)
    return scan


def snapshot_of(
    scan: Scan,
    rotation: np.ndarray | None = None,
    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
    unsettled: Callable[[np.ndarray], np.ndarray] | None = None,
    noise_mm: float = 0.002,
) -> MapSnapshot:
    """The map of a scan, all at once: cKDTree for the neighbours, numpy's SVD for the normals.

    `rotation` (3, 3) and `shift_mm` move part and scanlines together; `unsettled` tells from the points (n, 3) of the
    scan's own frame which are not settled.
    """
    rotation = np.eye(3) if rotation is None else rotation
    count = len(scan.points)
    own = np.concatenate(scan.points) if count else np.zeros((0, 3))
    points = own @ rotation.T + np.asarray(shift_mm)
    line = np.repeat(np.arange(count), [len(p) for p in scan.points]).astype(np.int32)
    n = len(points)
    spacing = np.array(scan.spacing)
    radius = (np.sqrt(2.0) * spacing + 0.1)[line]
    laser = np.array(scan.laser).reshape(-1, 3) @ rotation.T + np.asarray(shift_mm)
    near = cKDTree(points).query_ball_point(points, radius * (1 + 1e-12)) if n else []
    neighbours = np.array([len(rows) for rows in near], np.int32)
    normals = np.full((n, 3), np.nan)
    unreliable = np.zeros(n, np.uint8)
    offset, residual, error = np.zeros(n), np.full(n, np.nan), np.full(n, np.nan)
    for count_near in np.unique(neighbours).tolist():  # all points with as many neighbours at once
        i = np.flatnonzero(neighbours == count_near)
        rows = np.stack([near[k] for k in i])
        found = points[rows]
        mean = found.mean(axis=1)
        offset[i] = np.linalg.norm(mean - points[i], axis=1) / radius[i]
        if count_near < 6:
            unreliable[i] = Unreliable.TOO_FEW
        same = np.diff(np.sort(line[rows], axis=1), axis=1) == 0
        again = same & ~np.pad(same, ((0, 0), (1, 0)))[:, :-1]  # a line's second point
        lines_near, lines_with_two = count_near - same.sum(axis=1), again.sum(axis=1)
        unreliable[i[(unreliable[i] == 0) & (lines_near < 3) & (lines_with_two < 2)]] = Unreliable.SINGLE_LINE
        if count_near < 4:
            continue
        _, s, axes = np.linalg.svd(found - mean[:, None], full_matrices=False)
        residual[i] = s[:, 2] / np.sqrt(count_near - 3)
        error[i] = np.maximum(noise_mm, residual[i]) / np.maximum(s[:, 1], 1e-12)
        unreliable[i[(unreliable[i] == 0) & (error[i] > np.radians(5.0))]] = Unreliable.ILL_DETERMINED
        up = np.where(np.sum(axes[:, 2] * (laser[line[i]] - points[i]), axis=1) >= 0, 1.0, -1.0)
        good = unreliable[i] == 0
        normals[i[good]] = (axes[:, 2] * up[:, None])[good]
    point_spacing = np.array(
        [np.median(np.linalg.norm(np.diff(p, axis=0), axis=1)) if len(p) > 1 else np.nan for p in scan.points]
    )
    lines = LineTable(
        device_ids=("test",),
        device=np.zeros(count, np.int32),
        boot_id=np.ones(count, np.int64),
        pass_number=np.array(scan.pass_number, np.int32),
        line_index=np.array(scan.line_index, np.int64),
        point_count=np.full(count, scan.places, np.int32),
        laser_mm=laser,
        plane_normal=np.tile(rotation @ [0.0, 1.0, 0.0], (count, 1)),
        travel=np.tile(rotation @ [0.0, 1.0, 0.0], (count, 1)),
        position_mm=np.array(scan.position),
        line_spacing_mm=spacing,
        step_mm=np.full(count, np.nan),
        point_spacing_mm=point_spacing,
        stationary=np.zeros(count, bool),
    )
    return MapSnapshot(
        version=1,
        origin_mm=np.zeros(3),
        points_mm=points,
        line=line,
        index=np.concatenate(scan.index).astype(np.int32) if count else np.zeros(0, np.int32),
        radius_mm=radius,
        radius_rule=np.full(n, RadiusRule.LINE_SPACING, np.uint8),
        neighbours=neighbours,
        same_side=neighbours,
        density_per_mm2=neighbours / (np.pi * radius**2),
        normals=normals,
        unreliable=unreliable,
        settled=np.ones(n, bool) if unsettled is None else ~unsettled(own),
        isolated=neighbours <= 3,
        offset=offset,
        residual_mm=residual,
        normal_error_rad=error,
        lines=lines,
    )
