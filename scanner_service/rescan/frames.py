"""How each pass looks at the part: direction of its lines, middle of its fan, step of its rays; judges nothing.

A scanner that goes round the part, or under which the part turns, looks another way in each line: its frame is that of
the first line, and turns with the plane of the laser.

Told from the first lines of a pass, so that what is said of a line does not change with every line after it: from the
first 1, 4, 16, 64 and at last 256 of them.
"""

from dataclasses import dataclass

import numpy as np

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.snapshot import LineTable, MapSnapshot
from scanner_service.rescan.excerpt import rows_of_lines
from scanner_service.rescan.stations import IntArray, Stations

_STEPS = (1, 4, 16, 64, 256)
_TURNED = 0.02  # sine: normals that are further apart tell of a turn, ...
_ABOUT_ONE = 0.2  # ... if they differ along its axis by less than this share of what they do across
_ROUND = 0.3  # sine: ... and lean away from it: planes that wander a little all differ about their mean normal
_UPRIGHT = 0.05  # sine: the sensor's z lies in the plane of the laser


@dataclass(frozen=True, slots=True)
class Frames:
    """One row a pass, numbered as `Stations.group` does.

    `along` (p, 3) is the unit direction of its lines (x where they have no extent), `axis` (p, 3) the unit direction
    that depth is measured along, away from the sensor, `pitch_rad` (p,) the angle between neighbouring rays (NaN: no
    two of them returned), `distance_mm` (p,) the usual one from laser to surface. `lines` (p,) says of how many lines
    that is. Of passes that go round, `turn` (p, 3) is the unit axis, else NaN; `along` and `axis` are then those of the
    line whose plane has the normal `plane` (p, 3). `in_force` (p,) is False for passes no point of which counts: a
    withdrawn one is as if it had never been.
    """

    along: Float64Array
    axis: Float64Array
    pitch_rad: Float64Array
    distance_mm: Float64Array
    lines: IntArray
    turn: Float64Array
    plane: Float64Array
    in_force: BoolArray

    def __post_init__(self) -> None:
        for name in self.__slots__:
            read_only(getattr(self, name))

    def __len__(self) -> int:
        return len(self.along)

    @property
    def several(self) -> bool:
        """Whether more than one pass is in force."""
        return int(self.in_force.sum()) > 1

    def of_lines(self, lines: LineTable, rows: IntArray, group: IntArray) -> tuple[Float64Array, Float64Array]:
        """(k, 3) directions of some lines (rows (k,), passes `group` (k,)), and (k, 3) those of their depth."""
        along, axis = self.along[group], self.axis[group]
        round_ = np.flatnonzero(np.isfinite(self.turn[group, 0]) & np.isfinite(lines.plane_normal[rows, 0]))
        turn, plane = self.turn[group[round_]], self.plane[group[round_]]
        angle = _angles(turn, plane, lines.plane_normal[rows[round_]])
        along[round_], axis[round_] = (_turned(vectors[round_], turn, angle) for vectors in (along, axis))
        return along, axis


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
    turn, plane = np.full((passes, 3), np.nan), np.full((passes, 3), np.nan)
    for number in range(passes):
        lines = np.flatnonzero(stations.group == number)
        used[number] = max((step for step in _STEPS if step <= len(lines)), default=0)
        if earlier is not None and number < known and earlier.lines[number] == used[number]:
            along[number], axis[number] = earlier.along[number], earlier.axis[number]
            pitch[number], distance[number] = earlier.pitch_rad[number], earlier.distance_mm[number]
            turn[number], plane[number] = earlier.turn[number], earlier.plane[number]
            continue
        rows = rows_of_lines(snapshot, lines[: used[number]])
        if not len(rows):
            continue
        rows = rows[np.lexsort((snapshot.index[rows], snapshot.line[rows]))]
        ray = snapshot.points_mm[rows] - snapshot.lines.laser_mm[snapshot.line[rows]]
        chord = _chords(snapshot, rows)
        normals = snapshot.lines.plane_normal[snapshot.line[rows]]
        plane[number], turn[number] = normals[0], _turn_of(snapshot.lines.plane_normal[lines[: used[number]]])
        if np.isfinite(turn[number, 0]):
            back = -_angles(turn[[number]], plane[[number]], normals)
            ray = _turned(ray, turn[[number]], back)
            chord = _turned(chord, turn[[number]], back[np.unique(snapshot.line[rows], return_index=True)[1]])
        along[number] = _direction(chord)
        axis[number] = _axis(ray, along[number], turn[number], plane[number], towards_sensor)
        angle = angle_and_depth(ray, along[[number]], axis[[number]])[0]
        next_to = (np.diff(snapshot.line[rows]) == 0) & (np.diff(snapshot.index[rows]) == 1)
        step = np.abs(np.diff(angle))[next_to]
        pitch[number] = np.median(step) if len(step) else np.nan
        distance[number] = np.median(np.linalg.norm(ray, axis=1))
    counted = stations.group[snapshot.line[snapshot.neighbours > 0]]
    in_force = np.bincount(counted, minlength=passes) > 0
    return Frames(along, axis, pitch, distance, used, turn, plane, in_force)


def angle_and_depth(ray_mm: Float64Array, along: Float64Array, axis: Float64Array) -> tuple[Float64Array, Float64Array]:
    """(n,) angle in the fan and (n,) depth of rays (n, 3) in frames given by `along` and `axis`, (n, 3) or (1, 3)."""
    across = along - axis * np.einsum("ij,ij->i", along, axis)[:, None]
    across = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)  # along the ray: no angle but 0
    depth = (ray_mm * axis).sum(axis=1)
    return np.arctan2((ray_mm * across).sum(axis=1), depth), depth


def _chords(snapshot: MapSnapshot, rows: IntArray) -> Float64Array:
    """(l, 3) way from the first to the last point of each line, whose points (rows) stand together."""
    borders = np.flatnonzero(np.diff(snapshot.line[rows])) + 1
    first, last = np.concatenate([[0], borders]), np.concatenate([borders, [len(rows)]]) - 1
    return np.asarray(snapshot.points_mm[rows[last]] - snapshot.points_mm[rows[first]])


def _direction(chord: Float64Array) -> Float64Array:
    """(3,) unit direction of some chords (l, 3); x where they have no extent."""
    longest = chord[np.argmax(np.einsum("ij,ij->i", chord, chord))]
    total: Float64Array = (chord * np.sign(chord @ longest)[:, None]).sum(axis=0)
    length = float(np.linalg.norm(total))
    return total / length if length > 0 else np.array([1.0, 0.0, 0.0])


def _turn_of(normals: Float64Array) -> Float64Array:
    """(3,) unit axis about which the planes with these normals (l, 3) turn; NaN where they are parallel, or wander."""
    nowhere = np.full(3, np.nan)
    if not np.isfinite(normals).all() or np.linalg.norm(normals - normals[0], axis=1).max() < _TURNED:
        return nowhere
    _, spread, ways = np.linalg.svd(normals - normals.mean(axis=0), full_matrices=False)
    if len(spread) < 3 or spread[2] > _ABOUT_ONE * spread[1] or np.linalg.norm(np.cross(ways[2], normals[0])) < _ROUND:
        return nowhere
    return np.asarray(ways[2])


def _angles(turn: Float64Array, plane: Float64Array, normals: Float64Array) -> Float64Array:
    """(k,) angle about `turn` from the normals `plane` to `normals`; (k, 3) each, or (1, 3)."""
    across = np.cross(turn, plane)
    return np.asarray(np.arctan2((normals * across).sum(axis=1), (normals * np.cross(across, turn)).sum(axis=1)))


def _turned(vectors: Float64Array, turn: Float64Array, angle_rad: Float64Array) -> Float64Array:
    """Vectors (k, 3) turned about unit axes (k, 3) or (1, 3) by angles (k,) (Rodrigues)."""
    cosine, sine = np.cos(angle_rad)[:, None], np.sin(angle_rad)[:, None]
    along = turn * (vectors * turn).sum(axis=1)[:, None]
    return np.asarray(along + cosine * (vectors - along) + sine * np.cross(turn, vectors))


def _axis(
    ray_mm: Float64Array, along: Float64Array, turn: Float64Array, plane: Float64Array, towards: Float64Array | None
) -> Float64Array:
    """(3,) unit direction of depth in the plane with the normal `plane`; `towards` is the sensor's z in some line."""
    if towards is not None and np.isfinite(turn[0]):
        towards = _towards_in_plane(towards, turn, plane, -ray_mm.mean(axis=0))
    if towards is None or abs(float(towards @ plane)) > _UPRIGHT:  # not where the plane is NaN, unknown
        return _middle(ray_mm, along)
    return -np.asarray(towards)


def _towards_in_plane(
    towards: Float64Array, turn: Float64Array, plane: Float64Array, back: Float64Array
) -> Float64Array:
    """The sensor's z (3,) turned about an axis into the plane, to that of both places which is nearer to `back`."""
    along = turn * (towards @ turn)
    first = towards - along
    second = np.cross(turn, first)
    size = float(np.hypot(first @ plane, second @ plane))
    if size < _UPRIGHT:
        return towards
    middle = np.arctan2(second @ plane, first @ plane)
    off = np.arccos(np.clip(-(along @ plane) / size, -1.0, 1.0))
    both = [along + np.cos(angle) * first + np.sin(angle) * second for angle in (middle - off, middle + off)]
    return max(both, key=lambda one: float(one @ back))


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
