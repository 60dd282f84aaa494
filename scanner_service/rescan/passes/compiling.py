"""Compiling the kernels of the planner on a few points, before the first scan; knows no service."""

import numpy as np

from drivers.rig import Rig
from drivers.rig_limits import AxisKind, RigLimits
from drivers.scanline import Pose, SensorGeometry
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.passes.looks import look_of
from scanner_service.rescan.passes.motion import StraightMotion
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.planner import Wishes, plan_passes
from scanner_service.rescan.passes.reach import Reach
from scanner_service.rescan.regions import RegionReport


def compile_planner(snapshot: MapSnapshot, report: RegionReport) -> None:
    """Plan once over a small map, so that every kernel is compiled or loaded from the cache."""
    geometry = SensorGeometry(np.array([0.0, 0.0, 100.0]), np.array([0.0, 50.0, 100.0]), (-20.0, 20.0), 0.01)
    optics = ScannerOptics(geometry, 100.0, 600)
    limits = RigLimits(AxisKind.LINEAR, (-1.0, 10.0), (0.0, 50.0), (0.0, 50.0), geometry, (-50.0, 50.0))
    motion = StraightMotion(Pose.identity(), np.array([0.0, 1.0, 0.0]))
    look = look_of(snapshot, 0, motion, 0.0, 1.0, 600)
    looks = () if look is None else (look,)
    reach = Reach(limits, Rig(), part_may_turn=False)
    plan_passes(snapshot, report, reach, optics, Wishes(1e6, 1), None, None, looks)
