"""Regions of the simulator's demonstration part, piece by piece, against its drawing and the scanner's optics."""

from functools import cache

import numpy as np
import pytest

from drivers.scanline import Pose
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.regions import RegionReport, RescanRegion, find_regions
from simulators.optics import demo_scanner
from simulators.parts import demo_part
from tests.unit.rescan.plane_loops import crossings, flattened
from tests.unit.rescan.synthetic_scan import Scan, snapshot_of

SPACING_MM = 0.15


@cache
def scanned(x_mm: tuple[float, float], y_mm: tuple[float, float]) -> tuple[MapSnapshot, RegionReport]:
    """The part between two x and two y, as the demonstration scans it."""
    scanner, part, rng = demo_scanner(), demo_part(), np.random.default_rng(1)
    scan = Scan(places=scanner.points_per_line)
    for number, y in enumerate(np.arange(-1.0, 61.0, SPACING_MM)):
        if not y_mm[0] <= y <= y_mm[1]:
            continue
        pose = Pose(np.eye(3), np.array([0.0, y, 0.0]))
        x, z = scanner.expose(part.surface, pose, rng)
        seen = np.flatnonzero((x > x_mm[0]) & (x < x_mm[1]))
        scan.points.append(np.column_stack([x[seen], np.full(len(seen), y), z[seen]]))
        scan.index.append(seen)
        scan.line_index.append(number)
        scan.pass_number.append(1)
        scan.position.append(float(y))
        scan.laser.append(pose.apply(scanner.laser_mm))
        scan.spacing.append(SPACING_MM)
    snapshot = snapshot_of(scan, noise_mm=scanner.noise_mm)
    report = find_regions(snapshot, geometry=scanner.geometry(), towards_sensor=np.array([0.0, 0.0, 1.0]))
    return snapshot, report


def pocket() -> RegionReport:
    return scanned((-19.9, -2.0), (9.0, 25.3))[1]


def dome() -> RegionReport:
    return scanned((4.0, 18.9), (42.0, 58.0))[1]


def facing(report: RegionReport, direction: tuple[float, float, float]) -> list[RescanRegion]:
    return [region for region in report.regions if region.normal @ np.array(direction) > 0.8]  # NaN is not


def test_the_shadow_on_the_pocket_s_floor_is_one_region_of_its_true_area() -> None:
    regions = facing(pocket(), (0.0, -1.0, 0.0))
    assert [region.reason for region in regions] == [Reason.SHADOW]
    # the camera looks over the rim at y = 25, z = 14 down to the floor at z = 2; the rim is 14 mm wide, and the foot
    # as wide as the floor that the fan reaches past the edge at x = -4
    scanner = demo_scanner()
    laser_z, camera_y = float(scanner.laser_mm[2]), float(scanner.camera_mm[1])
    hidden_mm = camera_y * 12.0 / (laser_z - 2.0)
    foot_mm = 18.0 - 4.0 * (laser_z - 2.0) / (laser_z - 14.0)
    truth = np.hypot(12.0, hidden_mm) * (14.0 + foot_mm) / 2.0
    assert regions[0].area_mm2 == pytest.approx(truth, rel=0.15)
    outline = np.concatenate(regions[0].outline_mm)
    assert outline[:, 1].min() == pytest.approx(25.0 - hidden_mm, abs=2 * SPACING_MM)
    assert outline[:, 1].max() == pytest.approx(25.0, abs=2 * SPACING_MM)
    loops, _ = flattened(regions[0].outline_mm, outline)
    assert [crossings(loop) for loop in loops] == [0]


@pytest.mark.parametrize(
    ("direction", "reason"),
    [
        ((0.0, 1.0, 0.0), Reason.SHADOW),  # stands in the laser's plane
        ((-1.0, 0.0, 0.0), Reason.SHADOW),  # turned away from the laser
        ((1.0, 0.0, 0.0), Reason.STEEP),  # the laser grazes it, and some of its points return
    ],
)
def test_each_other_wall_of_the_pocket_is_one_region(direction: tuple[float, float, float], reason: Reason) -> None:
    assert [region.reason for region in facing(pocket(), direction)] == [reason]


def test_the_dome_has_one_band_that_is_steep_and_a_shadow_behind_it() -> None:
    (steep,) = (region for region in dome().regions if region.reason is Reason.STEEP)
    shadow, *others = (region for region in dome().regions if region.reason is Reason.SHADOW)
    assert len(dome().regions) == 2 + len(others)
    assert shadow.normal[1] < -0.8, "the camera looks from the other side"
    # the laser stands over x = 0: the foot of the dome's outer side, a few tenths high, is turned away from it
    for other in others:
        assert other.normal[0] > 0.7 and other.area_mm2 < 0.1 * shadow.area_mm2
    # the band begins where the next line is out of reach of a neighbourhood and goes around nearly all of the dome
    away = np.concatenate(steep.outline_mm) - [12.0, 50.0, 0.0]
    turn = np.sort(np.arctan2(away[:, 1], away[:, 0]))
    assert np.linalg.norm(away, axis=1) == pytest.approx(6.0, abs=0.1)
    assert np.diff(turn).max() < np.radians(100.0)
