"""A way of scanning a part under a posed scanner: the part and its truth, what the way has done, passes and lanes."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.rescan_parts import drawn
from benchmarks.scannable import Allowed, CoverageTruth, sample_surface, scannable
from drivers.rig_limits import AxisKind, RigLimits
from drivers.scanline import Float64Array, Pose, Scanline
from scanner_service.analysis.intake import quantise
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.rescan.passes.motion import StraightMotion
from scanner_service.rescan.passes.reach import Reach
from simulators.meshes import load_mesh
from simulators.optics import LaserLineScanner
from simulators.parts import PARTS, Part
from simulators.posed_rig import PosedScanner
from simulators.shapes import Surface

DENSITY_PER_MM2 = 20.0
MESHES = (("fandisk.obj", 30.0), ("gears.stl", 1.0), ("featuretype.STL", 10.0))
"""Each about 50 mm long, as the demo part is."""
DRAWN = "drawn-"


@dataclass(frozen=True, slots=True)
class Subject:
    """A part to scan, with its box and its truth."""

    name: str
    surface: Surface
    low_mm: Float64Array
    high_mm: Float64Array
    truth: Callable[[], CoverageTruth]


@dataclass(slots=True)
class Run:
    """What one way of scanning did: after each pass its end in seconds and the coverage."""

    way: str
    seconds: list[float] = field(default_factory=list)
    coverage: list[float] = field(default_factory=list)
    promised_mm2: list[float] = field(default_factory=list)
    reached_mm2: list[float] = field(default_factory=list)
    expected_mm2: list[float] = field(default_factory=list)
    found_mm2: list[float] = field(default_factory=list)
    besides_mm2: list[float] = field(default_factory=list)
    promised_between_mm2: list[tuple[float, float]] = field(default_factory=list)
    expected_between_mm2: list[tuple[float, float]] = field(default_factory=list)
    true_gain_mm2: list[float] = field(default_factory=list)
    planning_s: list[float] = field(default_factory=list)

    def seconds_to(self, share: float) -> float:
        """When the coverage was first `share`; inf: never. Within a pass it is not known, so its end counts."""
        for at_s, covered in zip(self.seconds, self.coverage, strict=True):
            if covered >= share:
                return at_s
        return math.inf


class Scan:
    """A part under a posed scanner: passes are driven, timed, mapped and counted."""

    def __init__(
        self, subject: Subject, reach: Reach, scanner: LaserLineScanner, with_map: bool, seed: int = 1
    ) -> None:
        self.reach = reach
        self.truth = subject.truth()
        self.run = Run("")
        self.standing: Pose | None = None
        self.map = LiveMap(MapSettings(noise_mm=scanner.noise_mm, max_points=8_000_000)) if with_map else None
        self._posed = PosedScanner(scanner, subject.surface, np.random.default_rng(seed))
        self._elapsed_s = 0.0
        self.looks: list[tuple[StraightMotion, float, float]] = []

    def drive(self, pose_at: Callable[[float], Pose], start_mm: float, end_mm: float, spacing_mm: float) -> None:
        """Carry out one pass; time goes on by the way there and by the pass."""
        begin = pose_at(start_mm)
        self._elapsed_s += self.reach.seconds_between(self.standing, begin)
        self._elapsed_s += self.reach.seconds(abs(end_mm - start_mm), spacing_mm)
        self.standing = pose_at(end_mm)
        self.looks.append((straight(pose_at), start_mm, end_mm))
        lines: list[Scanline] = list(self._posed.scan(pose_at, start_mm, end_mm, spacing_mm))
        self.truth.add(lines)
        if self.map is not None:
            for line in lines:
                self.map.add(quantise(line, self.map.origin_mm))
            self.map.close_all_passes()
        self.run.seconds.append(self._elapsed_s)
        self.run.coverage.append(self.truth.share)


def subject_of(name: str, scanner: LaserLineScanner, max_tilt_rad: float, meshes: Path | None) -> Subject:
    """A generated part by its name, one drawn by chance as `drawn-SEED`, or a mesh file; its truth worked out once."""
    surface: Surface
    scales = dict(MESHES)
    if name.startswith(DRAWN):
        with TemporaryDirectory() as folder:
            drawn(int(name.removeprefix(DRAWN))).export(Path(folder) / f"{name}.stl")
            surface = mesh = load_mesh(Path(folder) / f"{name}.stl", 1.0)
        low, high = mesh.bounds_mm
    elif name in PARTS:
        part: Part = PARTS[name]()
        surface = part.surface
        low, high = np.array([-24.0, -1.0, -7.0]), np.array([24.0, 61.0, 20.0])
    else:
        if meshes is None:
            raise FileNotFoundError(f"the mesh {name} needs --meshes FOLDER")
        loose = load_mesh(meshes / name, scales[name])
        middle = 0.5 * (loose.bounds_mm[0] + loose.bounds_mm[1])
        mesh = load_mesh(meshes / name, scales[name], Pose(np.eye(3), -middle))
        surface = mesh
        low, high = mesh.bounds_mm
    rng = np.random.default_rng(7)
    samples = sample_surface(surface, low, high, 6000, rng)
    dense = sample_surface(surface, low, high, 150_000, rng)
    allowed = Allowed(max_tilt_rad, math.radians(60.0), scanner.camera_angle_rad)
    can = scannable(surface, samples, allowed)
    return Subject(name, surface, low, high, lambda: CoverageTruth(samples, dense, can, DENSITY_PER_MM2))


def reach_of(scanner: LaserLineScanner) -> Reach:
    """A sensor on an arm above the part: up to 70 degrees from the vertical, 200 lines/s, 100 mm/s between passes."""
    half = 0.5 * scanner.field_of_view_mm
    limits = RigLimits(
        AxisKind.FREE_POSE,
        (-math.inf, math.inf),
        (0.0, 200.0),
        (0.0, 200.0),
        scanner.geometry(),
        (-half, half),
        reach_mm=((-400.0, -400.0, -300.0), (400.0, 400.0, 400.0)),
    )
    return Reach(limits)


def raster_lanes(
    subject: Subject, scanner: LaserLineScanner, rotation: Float64Array
) -> Iterator[tuple[Callable[[float], Pose], float, float]]:
    """Lanes that cover the part's box in one attitude."""
    corners = np.array(
        [[x, y, z] for x in (subject.low_mm[0], subject.high_mm[0]) for y in (subject.low_mm[1], subject.high_mm[1])
         for z in (subject.low_mm[2], subject.high_mm[2])]
    ) @ rotation  # fmt: skip
    low, high = corners.min(axis=0), corners.max(axis=0)
    width = 0.8 * scanner.field_of_view_mm
    depth = 0.9 * (scanner.range_mm[1] - scanner.range_mm[0])
    forth = True
    for x in _middles(float(low[0]), float(high[0]), width):
        for z in _middles(float(low[2]), float(high[2]), depth):
            at_zero = Pose(rotation.copy(), rotation @ np.array([x, 0.0, z]))

            def pose_at(position_mm: float, at_zero: Pose = at_zero) -> Pose:
                return Pose(at_zero.rotation.copy(), at_zero.translation_mm + position_mm * at_zero.rotation[:, 1])

            ends = (float(low[1]), float(high[1]))
            yield (pose_at, *(ends if forth else ends[::-1]))
            forth = not forth


def straight(pose_at: Callable[[float], Pose]) -> StraightMotion:
    """The motion of a lane."""
    return StraightMotion(pose_at(0.0), pose_at(1.0).translation_mm - pose_at(0.0).translation_mm)


def _middles(low: float, high: float, width: float) -> list[float]:
    count = max(1, math.ceil((high - low) / width - 1e-9))
    step = (high - low) / count
    return [low + (k + 0.5) * step for k in range(count)]


def attitude(tilt_deg: float, azimuth_deg: float, roll_deg: float = 0.0) -> Float64Array:
    """Rotation of a sensor tilted from the vertical towards an azimuth, and rolled about its own z."""

    def about(axis: int, degrees: float) -> Float64Array:
        a, b = (axis + 1) % 3, (axis + 2) % 3
        turned = np.eye(3)
        cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        turned[a, a], turned[a, b], turned[b, a], turned[b, b] = cosine, -sine, sine, cosine
        return turned

    return about(2, azimuth_deg) @ about(1, tilt_deg) @ about(2, roll_deg)
