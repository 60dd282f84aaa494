"""Maps of simulated parts under a posed scanner, judged, for the tests of the planner."""

import math

import numpy as np

from drivers.rig_limits import AxisKind, RigLimits
from drivers.scanline import Pose
from scanner_service.analysis.intake import quantise
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.rescan.passes.motion import StraightMotion
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.reach import Reach
from scanner_service.rescan.regions import find_regions
from scanner_service.rescan.requirement import Requirement
from simulators.optics import demo_scanner
from simulators.posed_rig import PosedScanner
from simulators.shapes import Union, box

DENSITY = 20.0
SCANNER = demo_scanner()
OPTICS = ScannerOptics(SCANNER.geometry(), SCANNER.field_of_view_mm, SCANNER.points_per_line)
ASKED = Requirement(density_per_mm2=DENSITY)
FROM_ABOVE = StraightMotion(Pose.identity(), np.array([0.0, 1.0, 0.0]))
SMALL_STEP = Union(box((-10.0, 10.0, -6.0), (10.0, 30.0, 0.0)), box((-10.0, 20.0, -6.0), (10.0, 30.0, 5.0)))
"""The step of the simulator's parts, 20 mm x 20 mm of it: a quarter of the points, and of the time to plan."""

ALONG_SMALL_STEP = (9.0, 31.0)


class Bench:
    """A part under the scanner, and the map of it."""

    def __init__(self, surface, seed=1):
        self.posed = PosedScanner(SCANNER, surface, np.random.default_rng(seed))
        self.map = LiveMap(MapSettings(noise_mm=SCANNER.noise_mm, max_points=400_000))

    def scan(self, motion, start_mm, end_mm, spacing_mm):
        for line in self.posed.scan(motion.part_from_sensor, start_mm, end_mm, spacing_mm):
            self.map.add(quantise(line, self.map.origin_mm))
        self.map.close_all_passes()
        return self

    def judged(self, requirement=ASKED):
        snapshot = self.map.snapshot()
        return snapshot, find_regions(snapshot, requirement, SCANNER.geometry())


def free_reach(max_tilt_deg=70.0, box_mm=400.0):
    limits = RigLimits(
        AxisKind.FREE_POSE, (-math.inf, math.inf), (0.0, 200.0), (0.0, 200.0), SCANNER.geometry(), (-25.0, 25.0),
        reach_mm=((-box_mm,) * 3, (box_mm,) * 3),
    )  # fmt: skip
    return Reach(limits, max_tilt_rad=math.radians(max_tilt_deg))


def linear_reach(part_may_turn=False, travel_mm=(-2.0, 62.0)):
    limits = RigLimits(AxisKind.LINEAR, travel_mm, (0.0, 200.0), (0.0, 200.0), SCANNER.geometry(), (-25.0, 25.0))
    return Reach(limits, part_may_turn=part_may_turn)
