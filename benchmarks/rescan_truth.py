"""What is true of a part under a scanner, by dense ray casting on its mesh; imports neither service nor simulators.

The surface is sampled densely, and for every sample the sensor is put where its laser plane holds the sample. Then each
reason's truth is an inequality (`truth_of`):

    visible       n·u >= cos 80° and n·v > 0 (u, v: unit vectors to laser and camera), neither sight blocked, in the
                  fan, z_low <= z <= z_high, station within the sweep
    Δs'           g·|t·m| / sqrt(1 - (n·m)²), g the gap between the two lines around the sample
    δp'           D·dα / |d·e|: the angle between rays times the distance, on the surface (d along the line, e across
                  the ray)
    lost_lines    visible, line numbers missing in the gap, g > 1.5 Δs, q/(Δs'·δp') < ρ
    steep         visible, not lost, Δs'/g > sqrt(2) + c/Δs, or q/(Δs'·δp') < ρ at an incidence of more than 60°
    sparse        visible, neither of these, q/(Δs'·δp') < ρ
    out_of_range  visible but for z < z_low or z > z_high
    shadow        in the fan and in range, neither visible nor grazing, but beside what is: in some direction one looks
                  from it into the space between the laser and visible surface (a cavity that no gap in the scan betrays
                  is none); and not the end of the part: of the directions (48, even) in which one looks from it into
                  air that the laser passes without grazing what is behind, at least half meet first such air with
                  surface behind, seen or not, in fan and range (an outer side with nothing beside it is none, nor is
                  the wall of a hole right through)
    noisy         visible, and the noise there above the limit

q is the share of the rays that return from an incidence, a property of the scanner: 1 - (1 - cos incidence)^e. Beyond
80° fewer than half of the rays return: such `grazing` surface may be seen or not, and is left out. So is surface that
is turned to the camera by less than 10°, and what beside it (0.5 mm) is turned away by less than 10°: the least
unevenness, the facets of a mesh themselves, hides it or not. ρ is the required density less 5 % (what a scan cannot
tell). `band_of` marks the samples within one radius of a sample of
the other truth.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import trimesh
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh as EmbreeTriangles
from scipy.spatial import cKDTree

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]

_LIFT_MM = 0.01  # sights start this far off the surface: rays are cast in single precision
_GRAZING = 0.5  # cosine of 60°
_WALL = float(np.cos(np.radians(80.0)))
_SLACK = 1.05
_UNEVEN_MM = 0.5  # unevenness of a surface is no longer than this
_DIRECTIONS = 48
_FAR_MM = 25.0  # how far a shadow's surface looks for the space beside it, in small steps to the first light
_STEPS = (0.02, 0.04, 0.06, 0.08, 0.11, 0.15, 0.2, 0.28, 0.4, 0.55, 0.75, 0.95)


@dataclass(frozen=True, slots=True)
class Optics:
    """A laser-line scanner in its sensor frame: laser plane y = 0, x along the line, z towards the sensor.

    `laser_mm`, `camera_mm` (3,); the fan's `rays` cut z = 0 at equal steps over `field_of_view_mm`. Of the rays
    (1 - cos incidence)^`dropout_exponent` do not return; infinite: all do.
    """

    laser_mm: Floats
    camera_mm: Floats
    field_of_view_mm: float
    range_mm: tuple[float, float]
    rays: int
    dropout_exponent: float = np.inf

    @property
    def point_spacing_mm(self) -> float:
        """Distance of neighbouring rays at z = 0."""
        return self.field_of_view_mm / (self.rays - 1)


@dataclass(frozen=True, slots=True)
class Sweep:
    """One motion of the sensor along a straight line, part frame.

    At station s the sensor's origin is `origin_mm + s · travel` (3,), its axes the columns of `rotation` (3, 3).
    `stations_mm` (L,) rise, one a line that arrived; `numbers` (L,) are the lines' numbers, so that a step above 1 is a
    loss; `line_spacing_mm` is nominal.
    """

    rotation: Floats
    origin_mm: Floats
    travel: Floats
    stations_mm: Floats
    numbers: Ints
    line_spacing_mm: float


@dataclass(frozen=True, slots=True)
class Samples:
    """Surface at random places: `points_mm`, outward unit `normals` (n, 3), each standing for `area_mm2` mm²."""

    points_mm: Floats
    normals: Floats
    area_mm2: float

    def __len__(self) -> int:
        return len(self.points_mm)


class Caster:
    """Rays against a mesh: how far the first hit is, and on which triangle."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        corners = np.asarray(mesh.triangles, dtype=np.float64)
        self.normals: Floats = np.asarray(mesh.face_normals, dtype=np.float64)
        self._centre = corners.reshape(-1, 3).mean(axis=0)
        self._scene = rtcore_scene.EmbreeScene()
        self._triangles = EmbreeTriangles(self._scene, (corners - self._centre).astype(np.float32))

    def distance_mm(self, origins_mm: Floats, directions: Floats) -> Floats:
        """(n,) distance to the first hit of unit directions (n, 3); inf where there is none."""
        if not len(origins_mm):
            return np.zeros(0)
        start = np.ascontiguousarray(origins_mm - self._centre, dtype=np.float32)
        found = self._scene.run(start, np.ascontiguousarray(directions, dtype=np.float32), query="DISTANCE")
        distance = np.asarray(found, dtype=np.float64)
        return np.where(distance < 1e30, distance, np.inf)

    def first_hit(self, origins_mm: Floats, directions: Floats) -> tuple[Floats, Ints]:
        """(n,) distance to the first hit and (n,) the triangle hit; inf and -1 where there is none."""
        if not len(origins_mm):
            return np.zeros(0), np.zeros(0, dtype=np.int64)
        start = np.ascontiguousarray(origins_mm - self._centre, dtype=np.float32)
        found = self._scene.run(start, np.ascontiguousarray(directions, dtype=np.float32), output=1)
        triangle = np.asarray(found["primID"], dtype=np.int64)
        distance = np.asarray(found["tfar"], dtype=np.float64)
        return np.where(triangle >= 0, distance, np.inf), triangle

    def is_free(self, origins_mm: Floats, targets_mm: Floats) -> Bools:
        """(n,) True where nothing stands between origin and target (n, 3)."""
        way = targets_mm - origins_mm
        length = np.linalg.norm(way, axis=1)
        return np.asarray(self.distance_mm(origins_mm, way / length[:, None]) >= length)


@dataclass(frozen=True, slots=True)
class Sight:
    """What a sweep sees of each sample; arrays of n rows.

    `station_mm` is where the laser plane holds the sample, `angle_rad` its place in the fan, `lit` whether the laser
    reaches it (turned to it by at least 10°, nothing in between), `camera` whether the camera does (at any angle),
    `grazing` whether both do, but the laser at less than 10°, or whether the laser does and it is turned to the camera
    by less than 10°, or beside such surface away from it by less than 10°,
    `in_fan` and `in_range` whether fan, sweep and measurement range hold it. `incidence_rad` is the angle of normal and
    laser ray, `stretch` = |t·m| / sqrt(1 - (n·m)²), `along_mm` the spacing δp' of the rays on the surface, `laser_mm`
    (n, 3) where the laser then stands.
    """

    station_mm: Floats
    angle_rad: Floats
    lit: Bools
    camera: Bools
    grazing: Bools
    in_fan: Bools
    in_range: Bools
    incidence_rad: Floats
    stretch: Floats
    along_mm: Floats
    laser_mm: Floats

    @property
    def visible(self) -> Bools:
        """(n,) True where laser and camera see the sample within fan and range."""
        return self.lit & self.camera & self.in_fan & self.in_range

    def scannable(self, incidence_rad: float) -> Bools:
        """(n,) True where the sample is visible at no more than an incidence angle."""
        return np.asarray(self.visible & (self.incidence_rad <= incidence_rad))


def sample_surface(mesh: trimesh.Trimesh, spacing_mm: float, seed: int = 1) -> Samples:
    """Uniformly random samples, one for each square of the spacing."""
    count = max(1, int(mesh.area / spacing_mm**2))
    points, face = trimesh.sample.sample_surface(mesh, count, seed=seed)
    normals = np.asarray(mesh.face_normals, dtype=np.float64)[face]
    return Samples(np.asarray(points, dtype=np.float64), normals, float(mesh.area) / count)


def scan_coordinates(points_mm: Floats, optics: Optics, sweep: Sweep) -> tuple[Floats, Floats]:
    """Station (n,) at which the laser plane holds each point (n, 3), and its angle (n,) in the fan."""
    m = sweep.rotation[:, 1]
    station = (points_mm - sweep.origin_mm) @ m / float(sweep.travel @ m)
    own = _in_sensor(points_mm, station, sweep)
    return station, np.arctan2(own[:, 0] - optics.laser_mm[0], optics.laser_mm[2] - own[:, 2])


def sight_of(caster: Caster, samples: Samples, optics: Optics, sweep: Sweep) -> Sight:
    """Cast both sights of every sample from where its laser plane holds it."""
    m, t = sweep.rotation[:, 1], sweep.travel
    points, normals = samples.points_mm, samples.normals
    station, angle = scan_coordinates(points, optics, sweep)
    own = _in_sensor(points, station, sweep)
    base = sweep.origin_mm + station[:, None] * t
    laser = base + optics.laser_mm @ sweep.rotation.T
    camera = base + optics.camera_mm @ sweep.rotation.T
    lifted = points + _LIFT_MM * normals
    to_laser = laser - points
    distance = np.linalg.norm(to_laser, axis=1)
    to_laser = to_laser / distance[:, None]
    cosine = np.einsum("ij,ij->i", normals, to_laser)
    reached = cosine > 1e-6
    reached[reached] = caster.is_free(lifted[reached], laser[reached])
    lit = reached & (cosine >= _WALL)
    to_camera = camera - points
    towards = np.einsum("ij,ij->i", normals, to_camera) / np.linalg.norm(to_camera, axis=1)
    seen = towards > 0
    seen[seen] = caster.is_free(lifted[seen], camera[seen])
    height = float(optics.laser_mm[2])
    within = (station >= sweep.stations_mm[0]) & (station <= sweep.stations_mm[-1])
    along_line = np.cross(normals, m)
    sine = np.linalg.norm(along_line, axis=1)
    across_ray = np.cross(to_laser, m)
    with np.errstate(divide="ignore", invalid="ignore"):
        step_rad = optics.point_spacing_mm * np.cos(angle) ** 2 / height
        share = np.abs(np.einsum("ij,ij->i", along_line, across_ray)) / sine
        along = distance * step_rad / share
        stretch = abs(float(t @ m)) / sine
    return Sight(
        station_mm=station,
        angle_rad=angle,
        lit=lit,
        camera=seen,
        grazing=reached & ((~lit & seen) | _camera_grazes(points, reached, towards)),
        in_fan=_fan_holds(own, optics) & within,
        in_range=(own[:, 2] >= optics.range_mm[0]) & (own[:, 2] <= optics.range_mm[1]),
        incidence_rad=np.arccos(np.clip(cosine, -1.0, 1.0)),
        stretch=np.nan_to_num(stretch, nan=np.inf),
        along_mm=np.nan_to_num(along, nan=np.inf),
        laser_mm=laser,
    )


def _camera_grazes(points_mm: Floats, lit: Bools, towards: Floats) -> Bools:
    """(n,) True of lit surface turned to the camera by less than 10°, or away by less beside such surface.

    `towards` (n,) is the cosine of the camera's incidence, below 0 where the surface is turned away.
    """
    edge = lit & (np.abs(towards) < _WALL)
    found: Bools = edge & (towards > 0)
    away = np.flatnonzero(edge & ~found)
    if found.any() and len(away):
        apart = cKDTree(points_mm[found]).query(points_mm[away], distance_upper_bound=_UNEVEN_MM)[0]
        found[away] = np.isfinite(apart)
    return found


def truth_of(
    samples: Samples,
    sight: Sight,
    optics: Optics,
    sweep: Sweep,
    density_per_mm2: float,
    constant_mm: float = 0.1,
    is_noisy: Callable[[Floats], Bools] | None = None,
    caster: Caster | None = None,
) -> dict[str, Bools]:
    """Of each reason, which samples (n,) it is true of; at most one holds, but for `noisy`.

    Without a `caster` that of `shadow` is left out, which takes a hundred times as long as all others.
    """
    visible = sight.visible
    after = np.clip(np.searchsorted(sweep.stations_mm, sight.station_mm), 1, len(sweep.stations_mm) - 1)
    gap = sweep.stations_mm[after] - sweep.stations_mm[after - 1]
    missing = sweep.numbers[after] - sweep.numbers[after - 1] > 1
    with np.errstate(divide="ignore"):
        returned = 1.0 - (1.0 - np.clip(np.cos(sight.incidence_rad), 0.0, 1.0)) ** optics.dropout_exponent
        is_thin = returned / (gap * sight.stretch * sight.along_mm) < density_per_mm2 / _SLACK
    lost = visible & missing & (gap > 1.5 * sweep.line_spacing_mm) & is_thin
    beyond = sight.stretch > np.sqrt(2.0) + constant_mm / sweep.line_spacing_mm
    steep = visible & ~lost & (beyond | (is_thin & (np.cos(sight.incidence_rad) < _GRAZING)))
    noisy = visible & is_noisy(samples.points_mm) if is_noisy is not None else np.zeros(len(samples), dtype=bool)
    truth = {
        "steep": steep,
        "sparse": visible & ~lost & ~steep & is_thin,
        "lost_lines": lost,
        "out_of_range": sight.lit & sight.camera & sight.in_fan & ~sight.in_range,
        "noisy": noisy,
    }
    return truth if caster is None else truth | {"shadow": _shadow(caster, samples, sight, optics, sweep)}


def _shadow(caster: Caster, samples: Samples, sight: Sight, optics: Optics, sweep: Sweep) -> Bools:
    """Hidden surface beside what is seen, and not the end of the part.

    All samples look in the same even directions, so that neighbours of one surface see the same and the border of a
    shadow is a line. A sample that can be no shadow any more, or is one already, looks no further.
    """
    hidden = np.flatnonzero(sight.in_fan & sight.in_range & ~sight.visible & ~sight.grazing)
    beside_seen = np.zeros(len(hidden), dtype=np.bool_)
    over_part, over_nothing = np.zeros(len(hidden), dtype=np.int64), np.zeros(len(hidden), dtype=np.int64)
    normals = samples.normals[hidden]
    start = samples.points_mm[hidden] + _LIFT_MM * normals
    for number, towards in enumerate(_even_directions(_DIRECTIONS)):
        left = _DIRECTIONS - number
        ahead = over_part - over_nothing
        asked = np.flatnonzero((ahead + left >= 0) & ~(beside_seen & (ahead >= left)))
        way = towards + 1.02 * normals[asked]
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        free = np.minimum(caster.distance_mm(start[asked], way), _FAR_MM)
        first = np.ones(len(asked), dtype=np.bool_)
        for share in _STEPS:
            at = np.flatnonzero(first | ~beside_seen[asked])
            passes, meets, seen = _light_at(caster, start[asked[at]] + share * free[at, None] * way[at], optics, sweep)
            beside_seen[asked[at[seen]]] = True
            fresh = passes & first[at]
            over_part[asked[at[fresh & meets]]] += 1
            over_nothing[asked[at[fresh & ~meets]]] += 1
            first[at[fresh]] = False
    shadow = np.zeros(len(samples), dtype=bool)
    shadow[hidden] = beside_seen & (over_part >= over_nothing)
    return shadow


def _even_directions(count: int) -> Floats:
    """(count, 3) unit vectors spread evenly over the sphere, those that follow each other far apart."""
    at = np.arange(count)
    height = 1.0 - (2.0 * ((at * 0.618034) % 1.0) * (count - 1) + 1.0) / count
    turn = 2.0 * np.pi * at * 0.7548777
    around = np.sqrt(np.maximum(1.0 - height**2, 0.0))
    return np.column_stack([around * np.cos(turn), around * np.sin(turn), height])


def _light_at(caster: Caster, places_mm: Floats, optics: Optics, sweep: Sweep) -> tuple[Bools, Bools, Bools]:
    """(n,) of places in the air: whether the laser's light passes, lights the part behind, and is seen there.

    Light that grazes the part behind, as it does beside a wall along its way, passes for none of this.
    """
    t = sweep.travel
    station = scan_coordinates(places_mm, optics, sweep)[0]
    base = sweep.origin_mm + station[:, None] * t
    laser, camera = base + optics.laser_mm @ sweep.rotation.T, base + optics.camera_mm @ sweep.rotation.T
    ray = places_mm - laser
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    distance, face = caster.first_hit(laser, ray)
    passes = distance > np.linalg.norm(places_mm - laser, axis=1)
    within = (station >= sweep.stations_mm[0]) & (station <= sweep.stations_mm[-1])
    meets, seen = passes & (face >= 0) & within, np.zeros(len(places_mm), dtype=np.bool_)
    rows = np.flatnonzero(meets)
    foot = laser[rows] + distance[rows, None] * ray[rows]
    own = _in_sensor(foot, station[rows], sweep)
    held = _fan_holds(own, optics) & (own[:, 2] >= optics.range_mm[0]) & (own[:, 2] <= optics.range_mm[1])
    meets[rows[~held]] = False
    normals = caster.normals[face[rows]]
    lights = -np.einsum("ij,ij->i", normals, ray[rows]) >= _WALL
    passes[rows[held & ~lights]] = False
    clear = held & lights
    clear &= np.einsum("ij,ij->i", normals, camera[rows] - foot) > 0
    clear[clear] = caster.is_free((foot + _LIFT_MM * normals)[clear], camera[rows][clear])
    seen[rows[clear]] = True
    return passes, np.asarray(meets & passes), seen


def _fan_holds(own_mm: Floats, optics: Optics) -> Bools:
    """(n,) True for points (n, 3) of the sensor frame within the fan."""
    height = float(optics.laser_mm[2])
    at_zero = optics.laser_mm[0] + (own_mm[:, 0] - optics.laser_mm[0]) * height / (height - own_mm[:, 2])
    return np.asarray(np.abs(at_zero) <= 0.5 * optics.field_of_view_mm)


def band_of(samples: Samples, truth: Bools, radius_mm: float) -> Bools:
    """(n,) True within a radius of a sample of the other truth."""
    band = np.zeros(len(samples), dtype=bool)
    if truth.any() and not truth.all():
        for mine, others in ((truth, ~truth), (~truth, truth)):
            away = cKDTree(samples.points_mm[others]).query(samples.points_mm[mine], distance_upper_bound=radius_mm)[0]
            band[mine] = np.isfinite(away)
    return band


def _in_sensor(points_mm: Floats, station_mm: Floats, sweep: Sweep) -> Floats:
    """Points (n, 3) in the sensor frame of the station given for each."""
    offset: Floats = points_mm - sweep.origin_mm - station_mm[:, None] * sweep.travel
    return np.asarray(offset @ sweep.rotation, dtype=np.float64)
