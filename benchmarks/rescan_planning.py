"""How long one plan takes over a map of two million points, in seconds of processor time."""

import time

import numpy as np

from benchmarks.rescan_scan import DENSITY_PER_MM2, reach_of, straight
from drivers.scanline import Pose
from scanner_service.analysis.intake import quantise
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.rescan.passes.looks import look_of
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.planner import Wishes, plan_passes
from scanner_service.rescan.regions import find_regions
from scanner_service.rescan.requirement import Requirement
from simulators.optics import demo_scanner
from simulators.parts import demo_part
from simulators.posed_rig import PosedScanner


def main(points: int = 2_000_000) -> None:
    """Scan the demo part from above in fine lines until the map is large enough, then plan one pass, three times."""
    scanner = demo_scanner()
    posed = PosedScanner(scanner, demo_part().surface, np.random.default_rng(1))
    live_map = LiveMap(MapSettings(noise_mm=scanner.noise_mm, max_points=4_000_000))

    def above(position_mm: float) -> Pose:
        return Pose(np.eye(3), np.array([0.0, position_mm, 0.0]))

    passes = 0
    while len(live_map) < points:
        for line in posed.scan(above, -1.0 + 0.01 * passes, 61.0, 0.03):
            live_map.add(quantise(line, live_map.origin_mm))
        live_map.close_all_passes()
        passes += 1
    snapshot = live_map.snapshot()
    report = find_regions(snapshot, Requirement(density_per_mm2=DENSITY_PER_MM2), scanner.geometry())
    optics = ScannerOptics(scanner.geometry(), scanner.field_of_view_mm, scanner.points_per_line)
    looks = tuple(
        look
        for number in range(passes)
        if (look := look_of(snapshot, number, straight(above), -1.0 + 0.01 * number, 61.0, optics.rays)) is not None
    )
    for _ in range(3):
        begun, worked = time.perf_counter(), time.thread_time()
        plan = plan_passes(
            snapshot, report, reach_of(scanner), optics, Wishes(DENSITY_PER_MM2, 1), None, None, looks
        )  # fmt: skip
        print(
            f"{len(snapshot):,} points: {len(plan.passes)} pass planned in {time.thread_time() - worked:.2f} s of "
            f"processor time, {time.perf_counter() - begun:.2f} s on the clock",
            flush=True,
        )


if __name__ == "__main__":
    main()
