"""Visibility proved on real scans: from one range scan of the bunny, what scans from two other sides would see.

The scans' own poses are used (Stanford's bun.conf). The scanner's camera is not known, so the laser's line of sight
alone is predicted. And what is observed of the scans put together is held against the merged surface.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array, Pose, SensorGeometry
from scanner_service.analysis.intake import quantise
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.rescan.coverage import observed_coverage
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.passes.gain import prospect_of
from scanner_service.rescan.passes.known_surface import know_surface
from scanner_service.rescan.passes.motion import StraightMotion
from scanner_service.rescan.passes.needs import Needs
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.regions import find_regions
from scanner_service.rescan.requirement import Requirement
from scanner_service.storage.formats.opening import open_cloud, open_recording
from scanner_service.storage.formats.recording import ReadOptions

LASER_MM = (178.0, 1330.0)  # y and z of the laser in the scan's own frame; its x goes along
NEAR_MM = 1.5
MIDDLE_MM = 110.0


def poses_of(conf: Path) -> dict[str, Pose]:
    """world_from_scan of each file: the quaternion's rotation is transposed in this file's convention."""
    found = {}
    for line in conf.read_text().splitlines():
        words = line.split()
        if words and words[0] == "bmesh":
            x, y, z, qx, qy, qz, qw = map(float, words[2:])
            q = np.array([qx, qy, qz, qw])
            q /= np.linalg.norm(q)
            a, b, c, w = q
            rotation = np.array(
                [
                    [1 - 2 * (b * b + c * c), 2 * (a * b - c * w), 2 * (a * c + b * w)],
                    [2 * (a * b + c * w), 1 - 2 * (a * a + c * c), 2 * (b * c - a * w)],
                    [2 * (a * c - b * w), 2 * (b * c + a * w), 1 - 2 * (a * a + b * b)],
                ]
            )
            found[words[1]] = Pose(rotation.T.copy(), 1000.0 * np.array([x, y, z]))
    return found


def motion_of(world_from_scan: Pose) -> StraightMotion:
    """The scanner's own motion: the laser line along y, the travel along x, the sensor at +z."""
    scan_from_sensor = Pose(
        np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([0.0, MIDDLE_MM, 0.0])
    )
    return StraightMotion(world_from_scan @ scan_from_sensor, world_from_scan.rotation[:, 0].copy())


def compare(folder: Path, max_incidence_rad: float = np.radians(65.0)) -> dict[str, dict[str, float]]:
    """For each other scan: how much of what is predicted visible it covers, and which points it has elsewhere."""
    poses = poses_of(folder / "bun.conf")
    recording = open_recording(folder / "bun000.ply", ReadOptions(units="m"))
    live_map = LiveMap(MapSettings(noise_mm=0.1))
    for line in recording.lines:
        live_map.add(quantise(line, live_map.origin_mm))
    live_map.close_all_passes()
    snapshot = live_map.snapshot()
    none = np.zeros(len(snapshot), dtype=np.bool_)
    surface = know_surface(snapshot, none, np.zeros(len(snapshot), dtype=np.int32), 1.2)
    places = Needs.plain(surface.points_mm, surface.normals, surface.area_mm2)
    laser = np.array([-(LASER_MM[0] - MIDDLE_MM), 0.0, LASER_MM[1]])
    geometry = SensorGeometry(laser, laser.copy(), (-200.0, 200.0), 0.1)
    optics = ScannerOptics(geometry, 400.0, 400, max_incidence_rad=max_incidence_rad, max_camera_rad=np.radians(89.0))
    found = {}
    for name in ("bun045.ply", "bun180.ply"):
        other = open_recording(folder / name, ReadOptions(units="m"))
        points: Float64Array = np.concatenate([line.points_mm for line in other.lines])
        points = poses[name].apply(points[np.isfinite(points).all(axis=1)])
        prospect = prospect_of(surface, places, motion_of(poses[name]), optics)
        visible = prospect.coarsest_mm > 0
        covered = np.isfinite(cKDTree(points).query(surface.points_mm, distance_upper_bound=NEAR_MM)[0])
        near, found_at = cKDTree(surface.points_mm).query(points, distance_upper_bound=NEAR_MM)
        which = np.asarray(found_at, dtype=np.int64)
        on_known = np.isfinite(near)
        area = surface.area_mm2
        found[name] = {
            "known_mm2": float(area.sum()),
            "predicted_mm2": float(area[visible].sum()),
            "covered_share_of_predicted": float(area[visible & covered].sum() / max(area[visible].sum(), 1e-9)),
            "points_on_known": float(on_known.sum()),
            "points_where_invisible_share": float((~visible[which[on_known]]).mean()) if on_known.any() else 0.0,
            "points_on_new_surface": float((~on_known).sum()),
        }
    return found


def together(folder: Path, density_per_mm2: float = 0.6) -> dict[str, dict[str, float]]:
    """After each of the scans, as passes of one map: how much of the merged surface has a point near, and what is told.

    Far from all points lies also what no gap shows: the underside, and the back until its scan is there.
    """
    merged = open_cloud(folder / "bun_zipper.ply", ReadOptions(units="m")).points_mm
    poses, live_map, points = poses_of(folder / "bun.conf"), LiveMap(MapSettings(noise_mm=0.1)), []
    found = {}
    for number, name in enumerate(("bun000.ply", "bun045.ply", "bun180.ply")):
        pose = poses[name]
        for line in open_recording(folder / name, ReadOptions(units="m")).lines:
            placed = replace(
                line,
                pass_index=number,
                points_mm=pose.apply(line.points_mm),
                laser_mm=pose.apply(line.laser_mm[None])[0],
                plane_normal=pose.rotate(line.plane_normal[None])[0],
                travel=pose.rotate(line.travel[None])[0],
            )
            live_map.add(quantise(placed, live_map.origin_mm))
            points.append(placed.points_mm[np.isfinite(placed.points_mm).all(axis=1)])
        live_map.close_all_passes()
        snapshot = live_map.snapshot()
        report = find_regions(snapshot, Requirement(density_per_mm2=density_per_mm2))
        shadows = [region for region in report.regions if region.reason is Reason.SHADOW]
        found[name] = {
            "true_share": float(np.mean(cKDTree(np.concatenate(points)).query(merged)[0] <= NEAR_MM)),
            "observed_share": observed_coverage(snapshot, report).share,
            "shadows": float(len(shadows)),
            "shadows_mm2": float(sum(region.area_mm2 for region in shadows)),
        }
    return found


if __name__ == "__main__":
    for examine in (compare, together):
        for scan, figures in examine(Path(sys.argv[1])).items():
            print(examine.__name__, scan, figures)
