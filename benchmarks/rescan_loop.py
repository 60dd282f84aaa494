"""The closed loop measured: coverage of the scannable surface for the time spent, against three other ways to scan."""

import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

import numpy as np

from benchmarks.rescan_scan import (
    DENSITY_PER_MM2,
    Run,
    Scan,
    Subject,
    attitude,
    raster_lanes,
    reach_of,
    subject_of,
)
from drivers.scanline import Float64Array, Pose
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.passes.experience import experience_of
from scanner_service.rescan.passes.looks import look_of
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.outcome import Outcome, reckon
from scanner_service.rescan.passes.planner import Wishes, plan_passes
from scanner_service.rescan.passes.reach import Reach
from scanner_service.rescan.passes.recommendation import Plan, RecommendedPass
from scanner_service.rescan.passes.tried import Tried
from scanner_service.rescan.regions import RegionFinder, RegionReport
from scanner_service.rescan.requirement import Requirement
from scanner_service.sessions.mirror import Mirror
from simulators.optics import LaserLineScanner, demo_scanner

T = TypeVar("T")
FIRST_SPACING_MM = 0.35
RASTER_SPACINGS_MM = (0.35, 0.28, 0.22, 0.17, 0.12)
GOAL = 0.99
SHARES = (0.9, 0.95, 0.96, 0.97, 0.98, GOAL)
STILL_PASSES, STILL_SHARE = 8, 0.001
"""Largest hole first ends when so many passes brought less than this share of the surface."""
LEAST_MM2 = 1.0
"""What promises less promises nothing: a plan recommends no pass that brings less."""
_ROUNDED_MM2 = 0.05
LOST = 2.1
"""Other ways are followed until they took this many times as long as the loop in all."""
MAX_PASSES = 120


def first_pass(scan: Scan, subject: Subject, scanner: LaserLineScanner) -> None:
    """What every adaptive way begins with: the whole part once from above."""
    for pose_at, start, end in raster_lanes(subject, scanner, np.eye(3)):
        scan.drive(pose_at, start, end, FIRST_SPACING_MM)


def uniform_raster(
    subject: Subject, reach: Reach, scanner: LaserLineScanner, spacing_mm: float, until_s: float = math.inf
) -> Run:
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
        if scan.run.coverage[-1] >= GOAL or scan.run.seconds[-1] > until_s:
            break
    return scan.run


def at_random(
    subject: Subject, reach: Reach, scanner: LaserLineScanner, until_s: float = math.inf, seed: int = 3
) -> Run:
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
        if scan.run.coverage[-1] >= GOAL or scan.run.seconds[-1] > until_s:
            break
    return scan.run


def largest_hole_first(subject: Subject, reach: Reach, scanner: LaserLineScanner) -> Run:
    """Each pass looks straight at the largest region there is, as far along as the region goes."""
    scan = Scan(subject, reach, scanner, with_map=True)
    scan.run.way = "largest hole first"
    first_pass(scan, subject, scanner)
    tried: list[Float64Array] = []
    judge = Judge(scan, scanner)
    for _ in range(MAX_PASSES):
        _, report = judge.judged()
        regions = [
            region
            for region in sorted(report.regions, key=lambda one: -one.area_mm2)
            if np.isfinite(region.normal).all()
            and all(float(np.linalg.norm(region.centroid_mm - place)) > 2.0 for place in tried)
        ]
        if not regions or scan.run.coverage[-1] >= GOAL or _stands_still(scan.run):
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


def _stands_still(run: Run) -> bool:
    """True when the last passes together brought nothing worth their time."""
    return len(run.coverage) > STILL_PASSES and run.coverage[-1] - run.coverage[-1 - STILL_PASSES] < STILL_SHARE


class Judge:
    """The map of a scan and what is wrong with it, judged again where it has changed, as the service does."""

    def __init__(self, scan: Scan, scanner: LaserLineScanner) -> None:
        if scan.map is None:
            raise ValueError("only a scan with a map can be judged")
        self._map = scan.map
        self._mirror = Mirror()
        self._finder = RegionFinder(Requirement(density_per_mm2=DENSITY_PER_MM2), scanner.geometry())

    def judged(self) -> tuple[MapSnapshot, RegionReport]:
        """Now."""
        self._mirror.catch_up(self._ask, self._ask)
        snapshot, changed = self._mirror.changes()
        return snapshot, self._finder.find(snapshot, changed)

    def _ask(self, question: Callable[[LiveMap], T], /) -> T:
        return question(self._map)


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
    judge = Judge(scan, scanner)
    snapshot, report = judge.judged()
    plan: Plan | None = None
    for _ in range(MAX_PASSES):
        wishes = Wishes(DENSITY_PER_MM2, max_passes=1, learned=experience_of(earlier))
        begun = time.perf_counter()
        looks = [look_of(snapshot, n, *one, scanner.points_per_line) for n, one in enumerate(scan.looks)]
        seen = tuple(look for look in looks if look is not None)
        plan = plan_passes(snapshot, report, reach, optics, wishes, scan.standing, tried, seen)
        scan.run.planning_s.append(time.perf_counter() - begun)
        if not plan.passes or scan.run.coverage[-1] >= GOAL:
            break
        chosen = plan.passes[0]
        before = scan.truth.met_mm2
        scan.drive(chosen.motion.part_from_sensor, chosen.start_mm, chosen.end_mm, chosen.line_spacing_mm)
        was, was_report = snapshot, report
        snapshot, report = judge.judged()
        outcome: Outcome = reckon(chosen, was, was_report, snapshot, report, optics)
        tried = tried.and_also(outcome.missed_mm, outcome.empty_mm)
        earlier.append(outcome)
        for name in (
            "promised_mm2", "reached_mm2", "expected_mm2", "found_mm2", "besides_mm2", "promised_between_mm2",
            "expected_between_mm2",
        ):  # fmt: skip
            getattr(scan.run, name).append(getattr(outcome, name))
        scan.run.true_gain_mm2.append(scan.truth.met_mm2 - before)
        tell(_told(scan, chosen, outcome, plan, reach))
    return scan.run, scan, plan


def _told(scan: Scan, chosen: RecommendedPass, outcome: Outcome, plan: Plan, reach: Reach) -> str:
    run = scan.run
    kinds = ", ".join(f"{one.evidence.name.lower()} {one.reached_mm2:.0f}/{one.asked_mm2:.0f}" for one in outcome.kinds)
    return (
        f"  pass {len(run.seconds)}: {run.seconds[-1]:.1f} s, {run.coverage[-1]:.2%}, promised "
        f"{outcome.promised_mm2:.0f}, reached {outcome.reached_mm2:.0f}, expected {outcome.expected_mm2:.0f}, found "
        f"{outcome.found_mm2:.0f}, {outcome.besides_mm2:.0f} besides "
        f"({kinds}), truth {run.true_gain_mm2[-1]:.0f} mm2, "
        f"tilt {math.degrees(reach.tilt_rad(chosen.start_pose.rotation)):.0f}, spacing {chosen.line_spacing_mm:.3f}, "
        f"needed {plan.needed_mm2:.0f}, planned in {run.planning_s[-1]:.2f} s"
    )


def _ended(run: Run) -> str:
    return f"  {run.way}: {run.coverage[-1]:.2%} after {run.seconds[-1]:.1f} s"


def promises_of(run: Run) -> dict[str, dict[str, float]]:
    """How far reached was from promised, by the service's own reckoning, and found from expected where it explored.

    `median_error` is the median of |reached - promised| / promised over the passes that promise at least LEAST_MM2,
    `within` the share of them that came within the interval told, and `median_width` how wide that was for what was
    promised.
    """
    said = {
        "promised": (run.promised_mm2, run.reached_mm2, run.promised_between_mm2),
        "explored": (run.expected_mm2, run.found_mm2, run.expected_between_mm2),
    }
    return {
        name: _errors(np.array(mm2), np.array(came), np.array(between).reshape(-1, 2))
        for name, (mm2, came, between) in said.items()
    }


def _errors(said_mm2: Float64Array, came_mm2: Float64Array, between_mm2: Float64Array) -> dict[str, float]:
    counts = said_mm2 >= LEAST_MM2
    error = np.abs(came_mm2[counts] - said_mm2[counts]) / said_mm2[counts]
    low, high = between_mm2[counts].T
    within = (came_mm2[counts] >= low - _ROUNDED_MM2) & (came_mm2[counts] <= high + _ROUNDED_MM2)
    return {
        "passes": float(counts.sum()),
        "said_mm2": float(said_mm2.sum()),
        "came_mm2": float(came_mm2.sum()),
        "median_error": float(np.median(error)) if len(error) else math.nan,
        "within": float(within.mean()) if len(within) else math.nan,
        "median_width": float(np.median((high - low) / said_mm2[counts])) if len(within) else math.nan,
    }


def measure(name: str, meshes: Path | None, folder: Path, tell: Callable[[str], None]) -> dict[str, object]:
    """All ways over one part; writes the curves as JSON and as a picture."""
    scanner = demo_scanner()
    reach = reach_of(scanner)
    subject = subject_of(name, scanner, reach.max_tilt_rad, meshes)
    tell(f"{name}: {subject.truth().scannable_mm2:.0f} mm2 can be scanned")
    loop, _, _ = closed_loop(subject, reach, scanner, tell)
    return compared(subject, reach, scanner, loop, folder, tell)


def compared(
    subject: Subject, reach: Reach, scanner: LaserLineScanner, loop: Run, folder: Path, tell: Callable[[str], None]
) -> dict[str, object]:
    """The other ways over a part, against the closed loop; they are given up when the loop has long won."""
    runs = [loop]
    until_s = LOST * min(loop.seconds_to(GOAL), loop.seconds[-1])
    for spacing in RASTER_SPACINGS_MM:
        runs.append(uniform_raster(subject, reach, scanner, spacing, until_s))
        tell(_ended(runs[-1]))
    rasters = runs[1:]
    runs.append(at_random(subject, reach, scanner, until_s))
    tell(_ended(runs[-1]))
    runs.append(largest_hole_first(subject, reach, scanner))
    tell(_ended(runs[-1]))
    found = {
        "part": subject.name,
        "scannable_mm2": subject.truth().scannable_mm2,
        "coverage": loop.coverage[-1],
        "passes": len(loop.seconds),
        "seconds": loop.seconds[-1],
        "others_given_up_after_s": until_s,
        "seconds_to": {f"{share:.0%}": loop.seconds_to(share) for share in SHARES},
        "best_raster_seconds_to": {f"{share:.0%}": min(run.seconds_to(share) for run in rasters) for share in SHARES},
        "promises": promises_of(loop),
        "median_planning_s": float(np.median(loop.planning_s)),
        "runs": [asdict(run) for run in runs],
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"rescan-loop-{subject.name}.json").write_text(json.dumps(found, indent=1, default=str))
    draw_curves(runs, subject.name, folder / f"rescan-loop-{subject.name}.png")
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
