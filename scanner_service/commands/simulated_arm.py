"""A simulated arm: a client that moves a simulated scanner as pass orders say, and pushes what it sees.

It does what the client of a real arm does: it states its rig, moves from the start pose of an order that is running to
its end pose, pushes the scanlines, and stops the session. Nothing of the service but its REST is used.
"""

from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from typing import Any

import httpx
import numpy as np

from drivers.scanline import Pose, Scanline
from simulators.optics import demo_scanner
from simulators.parts import Part
from simulators.posed_rig import PosedScanner

LINE_RATE_HZ = 200.0
SPEED_MM_PER_S = 200.0
MAX_TILT_DEG = 70.0
_BOX_MM = ((-120.0, -100.0, -60.0), (120.0, 160.0, 120.0))  # of the sensor's origin, 150 mm before the laser
_LINES_A_REQUEST = 64


class SimulatedArm:
    """A demo scanner in the hand of an arm, over a part; it works for one session of pushed lines."""

    def __init__(self, client: httpx.Client, session_id: str, part: Part, seed: int) -> None:
        self._client = client
        self._session = f"/api/v1/sessions/{session_id}"
        self._scanner = demo_scanner()
        self._posed = PosedScanner(self._scanner, part.surface, np.random.default_rng(seed), "SIM-ARM")

    def state_rig(self) -> None:
        """Tell the service where the arm gets, and that it drives by itself."""
        optics = self._scanner
        self._ask(
            "PUT",
            "/rig",
            {
                "axis": "free_pose",
                "reach_low_mm": _BOX_MM[0],
                "reach_high_mm": _BOX_MM[1],
                "max_tilt_deg": MAX_TILT_DEG,
                "line_rate_hz": LINE_RATE_HZ,
                "speed_mm_per_s": SPEED_MM_PER_S,
                "driven_by_client": True,
                "scanner": {
                    "laser_mm": optics.laser_mm.tolist(),
                    "camera_mm": optics.camera_mm.tolist(),
                    "range_mm": optics.range_mm,
                    "field_of_view_mm": optics.field_of_view_mm,
                    "points_per_line": optics.points_per_line,
                    "noise_mm": optics.noise_mm,
                },
            },
        )

    def scan_from_above(self, start_mm: float, end_mm: float, line_spacing_mm: float) -> None:
        """The first pass: straight down, along y of the part."""

        def pose_at(position_mm: float) -> Pose:
            return Pose(np.eye(3), np.array([0.0, position_mm, 0.0]))

        self._ask("POST", "/start")
        self._push(pose_at, start_mm, end_mm, line_spacing_mm)
        self._ask("POST", "/stop")

    def carry_out(self, order: Mapping[str, Any]) -> None:
        """Move along the pass of an order that is running; the service takes it for over when the session stops."""
        one = order["pass"]
        start, end = (_pose(one[name]) for name in ("start_pose", "end_pose"))
        span_mm = one["end_mm"] - one["start_mm"]

        def pose_at(position_mm: float) -> Pose:
            share = (position_mm - one["start_mm"]) / span_mm
            way = end.translation_mm - start.translation_mm
            return Pose(start.rotation.copy(), start.translation_mm + share * way)

        self._push(pose_at, one["start_mm"], one["end_mm"], one["line_spacing_mm"], one["line_rate_hz"])
        self._ask("POST", "/stop")

    def _push(
        self,
        pose_at: Callable[[float], Pose],
        start_mm: float,
        end_mm: float,
        line_spacing_mm: float,
        line_rate_hz: float = LINE_RATE_HZ,
    ) -> None:
        lines = map(_told, self._posed.scan(pose_at, start_mm, end_mm, line_spacing_mm, line_rate_hz))
        for some in _by(lines, _LINES_A_REQUEST):
            self._ask("POST", "/scanlines", {"lines": some})

    def _ask(self, method: str, path: str, body: object = None) -> None:
        self._client.request(method, self._session + path, json=body).raise_for_status()


def _by(lines: Iterator[dict[str, Any]], count: int) -> Iterator[list[dict[str, Any]]]:
    while some := list(islice(lines, count)):
        yield some


def _pose(told: Mapping[str, Any]) -> Pose:
    return Pose(np.array(told["rotation"]), np.array(told["translation_mm"]))


def _told(line: Scanline) -> dict[str, Any]:
    """A scanline as REST takes it: a point without a return is null."""
    is_seen = np.asarray(np.isfinite(line.points_mm).all(axis=1))
    return {
        "device_id": line.device_id,
        "boot_id": line.boot_id,
        "pass_index": line.pass_index,
        "line_index": line.line_index,
        "device_time_s": line.device_time_s,
        "points_mm": [point.tolist() if seen else None for point, seen in zip(line.points_mm, is_seen, strict=True)],
        "laser_mm": line.laser_mm.tolist(),
        "plane_normal": line.plane_normal.tolist(),
        "travel": line.travel.tolist(),
        "position_mm": line.position_mm,
        "line_spacing_mm": line.line_spacing_mm,
        "step_mm": None if np.isnan(line.step_mm) else line.step_mm,
    }
