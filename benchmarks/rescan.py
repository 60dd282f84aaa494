"""Flagged area against the truth: simulated scans of parts that fail in known ways, judged and compared.

python -m benchmarks.rescan --json FILE [--meshes FOLDER] [--part NAME]
"""

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from benchmarks.rescan_flagged import Agreement, Looked, agreements_of_lit, agreements_of_shadows
from benchmarks.rescan_parts import PARTS, drawn, mesh_from
from benchmarks.rescan_truth import (
    Bools,
    Caster,
    Floats,
    Optics,
    Sweep,
    sample_surface,
    sight_of,
    truth_of,
)
from drivers.scanline import Pose, Scanline
from scanner_service.analysis.intake import quantise
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.regions import RegionReport, find_regions
from scanner_service.rescan.requirement import Requirement
from simulators.meshes import TriangleMesh
from simulators.optics import LaserLineScanner

LINE_SPACING_MM = 0.2
CONSTANT_MM = 0.1
NOISE_MM = 0.01
NOISY_FACTOR = 8.0
CLOSELY_MM = 0.1  # distance of the samples that tell what is seen: a quarter of the radius, as the band wants it
ISOLATED = "isolated"
MESHES = ("fandisk.obj", "gears.stl", "featuretype.STL")


@dataclass(frozen=True, slots=True)
class Case:
    """One scan with what went wrong in it: a part, a range, fast or lost lines, a noisy box, stray returns."""

    name: str
    part: trimesh.Trimesh
    range_mm: tuple[float, float] = (-30.0, 30.0)
    fast_mm: tuple[float, float] = (np.inf, np.inf)
    lost_mm: tuple[tuple[float, float], ...] = ()
    noisy_mm: tuple[float, float, float, float] | None = None  # x, y low and high
    strays: int = 0  # specks in the air: one to three returns beside each other, 2 to 10 mm in front of the part


def cases(only: str | None = None, meshes: Path | None = None, drawn_seeds: Sequence[int] = ()) -> list[Case]:
    """The cases of the generated parts, of parts drawn by chance, and of the mesh files of a folder."""
    found = [Case(f"drawn {seed}", drawn(seed)) for seed in drawn_seeds]
    for name, make in PARTS.items():
        if only in (None, name):
            if name == "bowl":
                found.append(Case(name, make(), range_mm=(-8.0, 30.0)))
            elif name == "waves":
                lost = ((30.0, 30.8), (34.0, 36.0), (39.0, 39.5))
                found.append(Case(name, make(), fast_mm=(5.0, 20.0), lost_mm=lost, noisy_mm=(-10.0, 8.0, 46.0, 62.0)))
            else:
                found.append(Case(name, make()))
    if only in (None, "strays"):
        found.append(Case("strays", PARTS["waves"](), strays=80))
    if meshes is not None:
        found += [
            Case(path.name, mesh_from(path))
            for path in (meshes / name for name in MESHES)
            if path.is_file() and only in (None, path.name)
        ]
    return found


def scanner_for(case: Case) -> LaserLineScanner:
    """The scanner of the benchmark: 150 mm away, camera 27 degrees aside, 480 rays over 56 mm."""
    camera = np.array([0.0, 150.0 * np.tan(np.radians(27.0)), 150.0])
    return LaserLineScanner(
        np.array([0.0, 0.0, 150.0]), camera, 56.0, case.range_mm, 480, NOISE_MM, dropout_exponent=4.0
    )


def sweep_for(case: Case) -> Sweep:
    """Along y over the whole part; three times as fast in one stretch, lines lost in others."""
    low, high = case.part.bounds[:, 1]
    stations, numbers, at, number = [], [], float(low) - 1.0, 0
    while at <= high + 1.0:
        if not any(first <= at < last for first, last in case.lost_mm):
            stations.append(at)
            numbers.append(number)
        at += (3.0 if case.fast_mm[0] <= at < case.fast_mm[1] else 1.0) * LINE_SPACING_MM
        number += 1
    return Sweep(
        np.eye(3),
        np.zeros(3),
        np.array([0.0, 1.0, 0.0]),
        np.array(stations),
        np.array(numbers, dtype=np.int64),
        LINE_SPACING_MM,
    )


def specks(case: Case, scanner: LaserLineScanner, sweep: Sweep, seed: int) -> dict[int, list[tuple[int, int, float]]]:
    """The stray returns of a scan by the number of their line: first ray, rays and millimetres towards the laser."""
    rng = np.random.default_rng([seed, 9])
    found: dict[int, list[tuple[int, int, float]]] = {}
    for number in rng.choice(sweep.numbers[12:-12], size=case.strays, replace=False).tolist():
        first = int(rng.integers(80, scanner.points_per_line - 120))
        found[number] = [(first, int(rng.integers(1, 4)), float(rng.uniform(2.0, 10.0)))]
    return found


def scan(case: Case, scanner: LaserLineScanner, sweep: Sweep, seed: int = 1) -> MapSnapshot:
    """Scan the part; the live map of it when the pass is closed."""
    rng = np.random.default_rng(seed)
    strays = specks(case, scanner, sweep, seed)
    surface = TriangleMesh(np.asarray(case.part.vertices), np.asarray(case.part.faces), Pose.identity())
    live = LiveMap(MapSettings(noise_mm=NOISE_MM, max_points=scanner.points_per_line * len(sweep.stations_mm) + 1))
    before = np.nan
    for station, number in zip(sweep.stations_mm.tolist(), sweep.numbers.tolist(), strict=True):
        pose = Pose(np.eye(3), np.array([0.0, station, 0.0]))
        x, z = scanner.expose(surface, pose, rng)
        points = np.column_stack([x, np.full_like(x, station), z])
        if case.noisy_mm is not None:
            noisy = is_in(points, case.noisy_mm)
            points[noisy, 2] += NOISE_MM * NOISY_FACTOR * rng.standard_normal(int(noisy.sum()))
        for first, count, towards_mm in strays.get(number, ()):
            way = pose.apply(scanner.laser_mm) - points[first : first + count]
            points[first : first + count] += towards_mm * way / np.linalg.norm(way, axis=1, keepdims=True)
        line = Scanline(
            device_id="benchmark",
            boot_id=1,
            pass_index=0,
            line_index=number,
            device_time_s=0.0,
            points_mm=points,
            missing=np.zeros(len(x), dtype=np.bool_),
            laser_mm=pose.apply(scanner.laser_mm),
            plane_normal=np.array([0.0, 1.0, 0.0]),
            travel=np.array([0.0, 1.0, 0.0]),
            position_mm=station,
            line_spacing_mm=LINE_SPACING_MM,
            step_mm=station - before,
        )
        before = station
        live.add(quantise(line, live.origin_mm))
    live.close_all_passes()
    snapshot = live.snapshot()
    live.close()
    return snapshot


def is_in(points_mm: Floats, box: tuple[float, float, float, float]) -> Bools:
    """(n,) True for points (n, 3) over a box x low, x high, y low, y high."""
    x, y = points_mm[:, 0], points_mm[:, 1]
    return np.asarray((x >= box[0]) & (x <= box[1]) & (y >= box[2]) & (y <= box[3]))


def judged(case: Case) -> tuple[MapSnapshot, RegionReport, LaserLineScanner, Sweep, Requirement]:
    """A case scanned and judged."""
    scanner, sweep = scanner_for(case), sweep_for(case)
    snapshot = scan(case, scanner, sweep)
    requirement = Requirement(density_per_mm2=0.5 / (LINE_SPACING_MM * scanner.point_spacing_mm))
    towards = np.array([0.0, 0.0, 1.0])
    return (
        snapshot,
        find_regions(snapshot, requirement, scanner.geometry(), NOISE_MM, towards),
        scanner,
        sweep,
        requirement,
    )


def compare(
    case: Case, spacing_mm: float, closely_mm: float = CLOSELY_MM, with_shadows: bool = True
) -> tuple[dict[str, Agreement], dict[str, Any]]:
    """Agreement by reason of one case, and what was scanned.

    Parameters
    ----------
    spacing_mm : distance of the samples that tell shadows, which take long, and where anything is to be flagged.
    closely_mm : distance of those that tell the other reasons. Their true area is a sliver here and there, and the
        band around its border is as exact as samples are close.
    """
    begun_s = time.perf_counter()
    snapshot, report, scanner, sweep, requirement = judged(case)
    optics = Optics(
        scanner.laser_mm,
        scanner.camera_mm,
        scanner.field_of_view_mm,
        scanner.range_mm,
        scanner.points_per_line,
        scanner.dropout_exponent,
    )
    box = case.noisy_mm
    is_noisy = None if box is None else (lambda points: is_in(points, box))
    assert requirement.density_per_mm2 is not None
    asked = (optics, sweep, requirement.density_per_mm2, CONSTANT_MM, is_noisy)
    radius = float(np.sqrt(2.0)) * LINE_SPACING_MM + CONSTANT_MM
    caster, samples = Caster(case.part), sample_surface(case.part, closely_mm)
    sight = sight_of(caster, samples, optics, sweep)
    closely = Looked(samples, sight, truth_of(samples, sight, *asked))
    found = agreements_of_lit(report.regions, closely, optics, sweep, radius)
    if with_shadows:
        samples = sample_surface(case.part, spacing_mm)
        sight = sight_of(caster, samples, optics, sweep)
        looked = Looked(samples, sight, truth_of(samples, sight, *asked, caster=caster))
        found |= agreements_of_shadows(report.regions, case.part, looked, optics, sweep, radius)
    found[ISOLATED] = isolated_returns(snapshot, report, specks(case, scanner, sweep, 1), radius)
    about = {
        "points": len(snapshot),
        "regions": len(report.regions),
        "samples": len(closely.samples),
        "seconds": time.perf_counter() - begun_s,
    }
    return found, about


def isolated_returns(
    snapshot: MapSnapshot, report: RegionReport, strays: dict[int, list[tuple[int, int, float]]], radius_mm: float
) -> Agreement:
    """How the verdict `isolated` agrees with the truth, in returns and not in mm2, for such points have no area.

    True: at most two other returns within the radius, counted here by a tree of all returns. What is found counts of
    the strays; returns of the part's own surface that stand alone may have another reason first.
    """
    alone = cKDTree(snapshot.points_mm).query_ball_point(snapshot.points_mm, radius_mm, return_length=True) <= 3
    stray = np.zeros(len(snapshot), dtype=bool)
    number = snapshot.lines.line_index[snapshot.line]
    for line, groups in strays.items():
        for first, count, _ in groups:
            stray |= (number == line) & (snapshot.index >= first) & (snapshot.index < first + count)
    flagged = report.reason == Reason.ISOLATED
    true = alone & stray
    return Agreement(*(float(np.count_nonzero(marks)) for marks in (true, true & flagged, flagged, flagged & alone)))


def run(case_list: list[Case], spacing_mm: float) -> dict[str, Any]:
    """Compare all cases; print a table, return the figures."""
    total: dict[str, Agreement] = {}
    by_part: dict[str, Any] = {}
    for case in case_list:
        found, about = compare(case, spacing_mm)
        by_part[case.name] = about | {reason: _figures(agreement) for reason, agreement in found.items()}
        for reason, agreement in found.items():
            total[reason] = total[reason] + agreement if reason in total else agreement
            if max(agreement.areas()) > 0:
                print(_line(f"{case.name:16s} {reason:13s}", agreement), flush=True)
    for reason, agreement in total.items():
        print(_line(f"{'all parts':16s} {reason:13s}", agreement), flush=True)
    return {"by_part": by_part, "total": {reason: _figures(agreement) for reason, agreement in total.items()}}


def _line(head: str, agreement: Agreement) -> str:
    unit = "returns" if ISOLATED in head else "mm2"
    return (
        f"{head} true {agreement.true_mm2:8.1f} {unit}  flagged {agreement.flagged_mm2:8.1f} {unit}  "
        f"recall {100 * agreement.recall:6.2f} %  precision {100 * agreement.precision:6.2f} %"
    )


def _figures(agreement: Agreement) -> dict[str, float | None]:
    recall, precision = agreement.recall, agreement.precision
    return {
        "true_mm2": agreement.true_mm2,
        "flagged_mm2": agreement.flagged_mm2,
        "recall": None if np.isnan(recall) else recall,
        "precision": None if np.isnan(precision) else precision,
    }


def main() -> None:
    """Run the cases asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--meshes", type=Path, help="folder with fandisk.obj, gears.stl, featuretype.STL")
    parser.add_argument("--part", help="one part only")
    parser.add_argument(
        "--drawn", type=int, nargs="*", default=[], help="seeds of parts drawn by chance, beside the others"
    )
    parser.add_argument("--drawn-only", action="store_true", help="nothing but the parts drawn by chance")
    parser.add_argument("--spacing", type=float, default=0.15, help="distance of the samples that tell shadows, mm")
    chosen = parser.parse_args()
    wanted = "" if chosen.drawn_only else chosen.part
    figures = run(cases(wanted, None if chosen.drawn_only else chosen.meshes, chosen.drawn), chosen.spacing)
    if chosen.json is not None:
        chosen.json.parent.mkdir(parents=True, exist_ok=True)
        chosen.json.write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
