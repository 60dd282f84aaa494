"""The closed loop measured: coverage of the scannable surface for the time spent, against three other ways to scan."""

import json
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.scannable import Allowed, CoverageTruth, sample_surface, scannable
from drivers.rig_limits import AxisKind, RigLimits
from drivers.scanline import Float64Array, Pose, Scanline
from scanner_service.analysis.intake import quantise
from scanner_service.analysis.live_map import LiveMap, MapSettings
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.passes.experience import chances_of
from scanner_service.rescan.passes.looks import look_of
from scanner_service.rescan.passes.motion import StraightMotion
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.outcome import Outcome, reckon
from scanner_service.rescan.passes.planner import Wishes, plan_passes
from scanner_service.rescan.passes.reach import Reach
from scanner_service.rescan.passes.recommendation import Plan, RecommendedPass
from scanner_service.rescan.passes.tried import Tried
from scanner_service.rescan.regions import RegionReport, find_regions
from scanner_service.rescan.requirement import Requirement
from simulators.meshes import load_mesh
from simulators.optics import LaserLineScanner, demo_scanner
from simulators.parts import PARTS, Part
from simulators.posed_rig import PosedScanner
from simulators.shapes import Surface

DENSITY_PER_MM2 = 20.0
FIRST_SPACING_MM = 0.35
RASTER_SPACINGS_MM = (0.35, 0.28, 0.22, 0.17, 0.12)
GOAL = 0.99
MAX_PASSES = 40
MESHES = (("fandisk.obj", 50.0), ("gears.stl", 1.0), ("featuretype.STL", 20.0))


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
    """A generated part by its name, or a mesh file, with its truth worked out once."""
    scales = dict(MESHES)
    if name in PARTS:
        part: Part = PARTS[name]()
        surface: Surface = part.surface
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


def first_pass(scan: Scan, subject: Subject, scanner: LaserLineScanner) -> None:
    """What every adaptive way begins with: the whole part once from above."""
    for pose_at, start, end in raster_lanes(subject, scanner, np.eye(3)):
        scan.drive(pose_at, start, end, FIRST_SPACING_MM)


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


def uniform_raster(subject: Subject, reach: Reach, scanner: LaserLineScanner, spacing_mm: float) -> Run:
    """The whole part at one spacing from above, then from all sides, steeper and steeper, until the goal or the end."""
    scan = Scan(subject, reach, scanner, with_map=False)
    scan.run.way = f"raster {spacing_mm:g} mm"
    order = [(0.0, 0.0, 0.0)]
    for tilt, offset, roll in ((45.0, 0.0, 0.0), (45.0, 45.0, 0.0), (65.0, 0.0, 0.0), (65.0, 45.0, 0.0),
                               (45.0, 0.0, 90.0), (65.0, 0.0, 90.0),
                               (30.0, 22.5, 180.0), (65.0, 22.5, 180.0)):  # fmt: skip
        order += [(tilt, offset + 90.0 * k, roll) for k in range(4)]
    for tilt, azimuth, roll in order:
        for pose_at, start, end in raster_lanes(subject, scanner, attitude(tilt, azimuth, roll)):
            scan.drive(pose_at, start, end, spacing_mm)
        if scan.run.coverage[-1] >= GOAL:
            break
    return scan.run


def at_random(subject: Subject, reach: Reach, scanner: LaserLineScanner, seed: int = 3) -> Run:
    """Passes over the whole part from random allowed attitudes, after the first from above."""
    scan = Scan(subject, reach, scanner, with_map=False)
    scan.run.way = "random"
    rng = np.random.default_rng(seed)
    first_pass(scan, subject, scanner)
    for _ in range(MAX_PASSES):
        tilt = math.degrees(math.acos(rng.uniform(math.cos(reach.max_tilt_rad), 1.0)))
        for pose_at, start, end in raster_lanes(
            subject, scanner, attitude(tilt, rng.uniform(0.0, 360.0), rng.uniform(0.0, 360.0))
        ):
            scan.drive(pose_at, start, end, rng.choice(RASTER_SPACINGS_MM))
        if scan.run.coverage[-1] >= GOAL:
            break
    return scan.run


def largest_hole_first(subject: Subject, reach: Reach, scanner: LaserLineScanner) -> Run:
    """Each pass looks straight at the largest region there is, as far along as the region goes."""
    scan = Scan(subject, reach, scanner, with_map=True)
    scan.run.way = "largest hole first"
    first_pass(scan, subject, scanner)
    tried: list[Float64Array] = []
    for _ in range(MAX_PASSES):
        _, report = judged(scan, scanner)
        regions = [
            region
            for region in sorted(report.regions, key=lambda one: -one.area_mm2)
            if np.isfinite(region.normal).all()
            and all(float(np.linalg.norm(region.centroid_mm - place)) > 2.0 for place in tried)
        ]
        if not regions or scan.run.coverage[-1] >= GOAL:
            break
        region = regions[0]
        tried.append(region.centroid_mm)
        azimuth = math.degrees(math.atan2(region.normal[1], region.normal[0]))
        tilt = min(math.degrees(math.acos(np.clip(region.normal[2], -1.0, 1.0))), math.degrees(reach.max_tilt_rad))
        rotation = attitude(tilt, azimuth)
        outline = np.concatenate(region.outline_mm) @ rotation
        centre = region.centroid_mm @ rotation
        at_zero = Pose(rotation, rotation @ np.array([centre[0], 0.0, centre[2]]))

        def pose_at(position_mm: float, at_zero: Pose = at_zero) -> Pose:
            return Pose(at_zero.rotation.copy(), at_zero.translation_mm + position_mm * at_zero.rotation[:, 1])

        scan.drive(pose_at, float(outline[:, 1].min()) - 1.0, float(outline[:, 1].max()) + 1.0, 0.22)
    return scan.run


def judged(scan: Scan, scanner: LaserLineScanner) -> tuple[MapSnapshot, RegionReport]:
    """The map and what is wrong with it."""
    assert scan.map is not None
    snapshot = scan.map.snapshot()
    return snapshot, find_regions(snapshot, Requirement(density_per_mm2=DENSITY_PER_MM2), scanner.geometry())


def closed_loop(
    subject: Subject, reach: Reach, scanner: LaserLineScanner, tell: Callable[[str], None] = lambda text: None
) -> tuple[Run, Scan, Plan | None]:
    """The planner's passes, one at a time, planned anew after each."""
    scan = Scan(subject, reach, scanner, with_map=True)
    scan.run.way = "closed loop"
    first_pass(scan, subject, scanner)
    optics = ScannerOptics(scanner.geometry(), scanner.field_of_view_mm, scanner.points_per_line)
    earlier: list[Outcome] = []
    tried = Tried.nothing()
    snapshot, report = judged(scan, scanner)
    plan: Plan | None = None
    for _ in range(MAX_PASSES):
        wishes = Wishes(DENSITY_PER_MM2, max_passes=1, chances=chances_of(earlier))
        begun = time.perf_counter()
        looks = [look_of(snapshot, n, *one, scanner.points_per_line) for n, one in enumerate(scan.looks)]
        seen = tuple(look for look in looks if look is not None)
        plan = plan_passes(snapshot, report, reach, optics, wishes, scan.standing, tried, seen)
        scan.run.planning_s.append(time.perf_counter() - begun)
        if not plan.passes or scan.run.coverage[-1] >= 0.9975:
            break
        chosen = plan.passes[0]
        before = scan.truth.met_mm2
        scan.drive(chosen.motion.part_from_sensor, chosen.start_mm, chosen.end_mm, chosen.line_spacing_mm)
        was, was_report = snapshot, report
        snapshot, report = judged(scan, scanner)
        outcome: Outcome = reckon(chosen, was, was_report, snapshot, report, optics)
        tried = tried.and_also(outcome.missed_mm, outcome.empty_mm)
        earlier.append(outcome)
        scan.run.promised_mm2.append(outcome.promised_mm2)
        scan.run.reached_mm2.append(outcome.reached_mm2)
        scan.run.true_gain_mm2.append(scan.truth.met_mm2 - before)
        tell(_told(scan, chosen, outcome, plan, reach))
    return scan.run, scan, plan


def _told(scan: Scan, chosen: RecommendedPass, outcome: Outcome, plan: Plan, reach: Reach) -> str:
    run = scan.run
    kinds = ", ".join(f"{one.evidence.name.lower()} {one.reached_mm2:.0f}/{one.asked_mm2:.0f}" for one in outcome.kinds)
    return (
        f"  pass {len(run.seconds)}: {run.seconds[-1]:.1f} s, {run.coverage[-1]:.2%}, promised "
        f"{outcome.promised_mm2:.0f}, reached {outcome.reached_mm2:.0f} and {outcome.besides_mm2:.0f} besides "
        f"({kinds}), truth {run.true_gain_mm2[-1]:.0f} mm2, "
        f"tilt {math.degrees(reach.tilt_rad(chosen.start_pose.rotation)):.0f}, spacing {chosen.line_spacing_mm:.3f}, "
        f"needed {plan.needed_mm2:.0f}, planned in {run.planning_s[-1]:.2f} s"
    )


def promise_errors(run: Run) -> Float64Array:
    """|reached - promised| / promised of each pass, by the service's own reckoning."""
    promised = np.array(run.promised_mm2)
    return np.asarray(np.abs(np.array(run.reached_mm2) - promised) / promised, dtype=np.float64)


def measure(name: str, meshes: Path | None, folder: Path, tell: Callable[[str], None]) -> dict[str, object]:
    """All ways over one part; writes the curves as JSON and as a picture."""
    scanner = demo_scanner()
    reach = reach_of(scanner)
    subject = subject_of(name, scanner, reach.max_tilt_rad, meshes)
    tell(f"{name}: {subject.truth().scannable_mm2:.0f} mm2 can be scanned")
    loop, _, plan = closed_loop(subject, reach, scanner, tell)
    runs = [loop]
    for spacing in RASTER_SPACINGS_MM:
        runs.append(uniform_raster(subject, reach, scanner, spacing))
        tell(f"  {runs[-1].way}: {runs[-1].coverage[-1]:.2%} after {runs[-1].seconds[-1]:.1f} s")
    runs += [at_random(subject, reach, scanner), largest_hole_first(subject, reach, scanner)]
    rasters = [run for run in runs if run.way.startswith("raster")]
    best_share = loop.coverage[-1]
    found = {
        "part": name,
        "scannable_mm2": subject.truth().scannable_mm2,
        "coverage": best_share,
        "passes": len(loop.seconds),
        "seconds": loop.seconds[-1],
        "seconds_to_99": loop.seconds_to(GOAL),
        "raster_seconds_to_99": min(run.seconds_to(GOAL) for run in rasters),
        "raster_seconds_to_same": min(run.seconds_to(best_share) for run in rasters),
        "median_promise_error": float(np.median(promise_errors(loop))) if loop.promised_mm2 else math.nan,
        "median_planning_s": float(np.median(loop.planning_s)),
        "unreachable_mm2": sum(one.area_mm2 for one in plan.unreachable) if plan else math.nan,
        "runs": [asdict(run) for run in runs],
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"rescan-loop-{name}.json").write_text(json.dumps(found, indent=1, default=str))
    draw_curves(runs, name, folder / f"rescan-loop-{name}.png")
    return found


def draw_curves(runs: list[Run], name: str, path: Path) -> None:
    """Coverage of the scannable surface over the time of scanning, one curve a way."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(8.0, 4.5), layout="constrained")
    greys = iter(("0.35", "0.45", "0.55", "0.65", "0.75"))
    for run in runs:
        is_loop, is_raster = run.way == "closed loop", run.way.startswith("raster")
        colour = "tab:blue" if is_loop else next(greys) if is_raster else None
        axes.step(
            [0.0, *run.seconds], [0.0, *(100.0 * share for share in run.coverage)], where="post", label=run.way,
            color=colour, linewidth=2.5 if is_loop else 1.2, linestyle="-" if is_loop or is_raster else "--",
        )  # fmt: skip
    axes.axhline(100.0 * GOAL, color="tab:red", linewidth=0.8)
    axes.set_xlabel("time of scanning, the ways between passes included, s")
    axes.set_ylabel("scannable surface that meets the density, %")
    axes.set_title(f"{name}: {DENSITY_PER_MM2:g} points/mm² wanted")
    axes.set_ylim(0.0, 101.0)
    axes.legend(loc="lower right", fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(arguments: list[str]) -> None:
    """`python -m benchmarks.rescan_loop PART [MESH FOLDER] [OUT]`: one part by name, or a mesh of a folder."""
    name = arguments[0] if arguments else "demo"
    meshes = Path(arguments[1]) if len(arguments) > 1 else None
    folder = Path(arguments[2]) if len(arguments) > 2 else Path("out")
    found = measure(name, meshes, folder, lambda text: print(text, flush=True))
    print({key: value for key, value in found.items() if key != "runs"})


if __name__ == "__main__":
    main(sys.argv[1:])
