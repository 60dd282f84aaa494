"""How each pass looks at the part: direction of its lines, middle of its fan, step of its rays; judges nothing.

Told from the first lines of a pass, so that what is said of a line does not change with every line after it: from the
first 1, 4, 16, 64 and at last 256 of them.
"""

from dataclasses import dataclass

import numpy as np

from drivers.scanline import Float64Array, read_only
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.excerpt import rows_of_lines
from scanner_service.rescan.stations import IntArray, Stations

_STEPS = (1, 4, 16, 64, 256)


@dataclass(frozen=True, slots=True)
class Frames:
    """One row a pass, numbered as `Stations.group` does.

    `along` (p, 3) is the unit direction of its lines (x where they have no extent), `axis` (p, 3) the unit direction
    that depth is measured along, away from the sensor, `pitch_rad` (p,) the angle between neighbouring rays (NaN: no
    two of them returned), `distance_mm` (p,) the usual one from laser to surface. `lines` (p,) says of how many lines
    that is.
    """

    along: Float64Array
    axis: Float64Array
    pitch_rad: Float64Array
    distance_mm: Float64Array
    lines: IntArray

    def __post_init__(self) -> None:
        for name in self.__slots__:
            read_only(getattr(self, name))

    def __len__(self) -> int:
        return len(self.along)


def frames_of(
    snapshot: MapSnapshot,
    stations: Stations,
    towards_sensor: Float64Array | None = None,
    earlier: Frames | None = None,
) -> Frames:
    """Measure the passes of a map.

    Parameters
    ----------
    towards_sensor : (3,) unit direction of the sensor's z in the part frame; without it the ray halfway between the
        outermost rays that returned stands for it, which is askew where the part fills one side of the fan.
    earlier : frames of the same map with fewer lines, whose passes had the same numbers: what it has measured on as
        many lines is taken over.
    """
    passes = int(stations.group.max(initial=-1)) + 1
    known = 0 if earlier is None else len(earlier)
    along, axis = np.tile([1.0, 0.0, 0.0], (passes, 1)), np.tile([0.0, 0.0, -1.0], (passes, 1))
    pitch, distance = np.full(passes, np.nan), np.zeros(passes)
    used = np.zeros(passes, dtype=np.int64)
    for number in range(passes):
        lines = np.flatnonzero(stations.group == number)
        used[number] = max((step for step in _STEPS if step <= len(lines)), default=0)
        if earlier is not None and number < known and earlier.lines[number] == used[number]:
            along[number], axis[number] = earlier.along[number], earlier.axis[number]
            pitch[number], distance[number] = earlier.pitch_rad[number], earlier.distance_mm[number]
            continue
        rows = rows_of_lines(snapshot, lines[: used[number]])
        if not len(rows):
            continue
        rows = rows[np.lexsort((snapshot.index[rows], snapshot.line[rows]))]
        ray = snapshot.points_mm[rows] - snapshot.lines.laser_mm[snapshot.line[rows]]
        along[number] = _direction(snapshot, rows)
        axis[number] = _middle(ray, along[number]) if towards_sensor is None else -np.asarray(towards_sensor)
        angle = angle_and_depth(ray, along[[number]], axis[[number]])[0]
        next_to = (np.diff(snapshot.line[rows]) == 0) & (np.diff(snapshot.index[rows]) == 1)
        step = np.abs(np.diff(angle))[next_to]
        pitch[number] = np.median(step) if len(step) else np.nan
        distance[number] = np.median(np.linalg.norm(ray, axis=1))
    return Frames(along, axis, pitch, distance, used)


def angle_and_depth(ray_mm: Float64Array, along: Float64Array, axis: Float64Array) -> tuple[Float64Array, Float64Array]:
    """(n,) angle in the fan and (n,) depth of rays (n, 3) in frames given by `along` and `axis`, (n, 3) or (1, 3)."""
    across = along - axis * np.einsum("ij,ij->i", along, axis)[:, None]
    across = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)  # along the ray: no angle but 0
    depth = (ray_mm * axis).sum(axis=1)
    return np.arctan2((ray_mm * across).sum(axis=1), depth), depth


def _direction(snapshot: MapSnapshot, rows: IntArray) -> Float64Array:
    """(3,) unit direction from the first to the last points of some lines; x where they have no extent."""
    line = snapshot.line[rows]
    borders = np.flatnonzero(np.diff(line)) + 1
    first, last = np.concatenate([[0], borders]), np.concatenate([borders, [len(line)]]) - 1
    chord = snapshot.points_mm[rows[last]] - snapshot.points_mm[rows[first]]
    longest = chord[np.argmax(np.einsum("ij,ij->i", chord, chord))]
    total: Float64Array = (chord * np.sign(chord @ longest)[:, None]).sum(axis=0)
    length = float(np.linalg.norm(total))
    return total / length if length > 0 else np.array([1.0, 0.0, 0.0])


def _middle(ray_mm: Float64Array, along: Float64Array) -> Float64Array:
    """(3,) unit direction halfway between the outermost of some rays."""
    mean: Float64Array = ray_mm.mean(axis=0)
    mean = mean - along * (mean @ along)
    if not np.linalg.norm(mean) > 0:
        return np.array([0.0, 0.0, -1.0])
    mean = mean / np.linalg.norm(mean)
    angle = np.arctan2(ray_mm @ along, ray_mm @ mean)
    middle = 0.5 * (angle.min() + angle.max())
    found: Float64Array = np.cos(middle) * mean + np.sin(middle) * along
    return found
