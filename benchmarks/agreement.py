"""Is the live answer the batch answer? Samples of a snapshot against the tests' oracle; measures no time."""

import math
from collections import Counter

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from benchmarks.cloud import NOISE_MM
from scanner_service.analysis.intake import StoredLine
from scanner_service.analysis.radius import radius_squared_q
from scanner_service.analysis.snapshot import MapSnapshot, RadiusRule
from tests.oracle import Q_MM, Oracle, OraclePoint

PLACES = 12
POINTS_AT_A_PLACE = 42
_HALF_WIDTH_MM = 1.2
_GROWTH = 1.25
_RADIUS_TOLERANCE_MM = 1e-9


class Agreement:
    """Compares one run with the oracle; `checked` and `failures` count points, the latter by what was wrong."""

    def __init__(
        self,
        lines: list[StoredLine],
        base_mm: float,
        limit_mm: float,
        max_error_rad: float,
        rng: np.random.Generator,
    ) -> None:
        self._lines = lines
        self._base_mm = base_mm
        self._limit_mm = limit_mm
        self._max_error_rad = max_error_rad
        self._rng = rng
        self._xyz_q = np.concatenate([line.xyz_q for line in lines])
        self._line = np.repeat(np.arange(len(lines)), [len(line.index) for line in lines])
        self._laser_mm = np.array([line.laser_mm for line in lines])
        self.checked = 0
        self.failures: Counter[str] = Counter()

    def check(self, snapshot: MapSnapshot, lines_in: int) -> None:
        """Compare points at some places anywhere, and at some at the front, after `lines_in` lines."""
        used = int(np.searchsorted(self._line, lines_in))
        if len(snapshot) != used:
            self.failures["rows"] += abs(len(snapshot) - used)
            return
        front = int(np.searchsorted(self._line, max(0, lines_in - 6)))
        for place in range(PLACES):
            centre = int(self._rng.integers(0 if place % 3 else front, used))
            self._check_place(snapshot, centre, lines_in, used)

    def check_all_counts(self, snapshot: MapSnapshot, workers: int) -> None:
        """Compare Np of every point: half-way between whole numbers, a squared radius leaves no doubt in float64."""
        xyz = self._xyz_q[: len(snapshot)].astype(np.float64)
        reach = np.sqrt(radius_squared_q(snapshot.radius_mm) + 0.5)
        counts = cKDTree(xyz).query_ball_point(xyz, reach, return_length=True, workers=workers)
        self.checked += len(snapshot)
        self.failures["neighbours"] += int((counts != snapshot.neighbours).sum())

    def _check_place(self, snapshot: MapSnapshot, centre: int, lines_in: int, used: int) -> None:
        away_q = np.abs(self._xyz_q[:used].astype(np.int64) - self._xyz_q[centre]).max(axis=1)
        cloud = np.flatnonzero(away_q <= (_HALF_WIDTH_MM + self._limit_mm) / Q_MM + 1)
        inner = np.flatnonzero(away_q[cloud] <= _HALF_WIDTH_MM / Q_MM)
        inner = self._rng.choice(inner, min(POINTS_AT_A_PLACE, len(inner)), replace=False)
        line = self._line[cloud]
        oracle = Oracle(self._xyz_q[cloud], snapshot.radius_mm[cloud], line, self._laser_mm[line], NOISE_MM)  # type: ignore[no-untyped-call]
        front_mm = float(self._laser_mm[lines_in - 1, 1])
        for at in inner:
            self.checked += 1
            for failure in self._wrong_about(snapshot, int(cloud[at]), oracle, int(at), front_mm):
                self.failures[failure] += 1

    def _wrong_about(self, snapshot: MapSnapshot, row: int, oracle: Oracle, at: int, front_mm: float) -> list[str]:
        wrong = []
        truth = oracle.at(at)  # type: ignore[no-untyped-call]
        used_mm = float(snapshot.radius_mm[row])
        if snapshot.neighbours[row] != truth.neighbours:
            wrong.append("neighbours")
        density = truth.neighbours / (math.pi * used_mm**2)
        if not math.isclose(snapshot.density_per_mm2[row], density, rel_tol=1e-12):
            wrong.append("density")
        is_reliable = bool(snapshot.reliable[row])
        if self._is_reliable(truth) not in (is_reliable, None):
            wrong.append("reliable")
        if is_reliable and truth.is_comparable:
            wrong.extend(_wrong_normal(snapshot.normals[row], truth))
        if not self._is_grown_as_needed(used_mm, is_reliable, oracle, at):
            wrong.append("radius")
        if (snapshot.radius_rule[row] == RadiusRule.GROWN) != (used_mm > self._base_mm + _RADIUS_TOLERANCE_MM):
            wrong.append("radius rule")
        y_mm = float(self._xyz_q[row, 1]) * Q_MM
        if bool(snapshot.settled[row]) != (front_mm - y_mm > self._limit_mm):
            wrong.append("settled")
        return wrong

    def _is_reliable(self, truth: OraclePoint) -> bool | None:
        """Section by section of the definition; None on its edge, where rounding decides."""
        two_lines = len(truth.line_counts) == 2 and min(truth.line_counts) >= 2
        if truth.neighbours < 6 or not (two_lines or len(truth.line_counts) >= 3):
            return False
        if not truth.is_comparable or abs(truth.predicted_error_rad - self._max_error_rad) < 1e-9:
            return None
        return bool(truth.predicted_error_rad <= self._max_error_rad)

    def _is_grown_as_needed(self, used_mm: float, is_reliable: bool, oracle: Oracle, at: int) -> bool:
        """The radius is the first of the ladder that makes the point reliable, or the rule's own if none does."""
        ladder = [self._base_mm]
        while ladder[-1] < self._limit_mm:
            ladder.append(min(self._base_mm * _GROWTH ** len(ladder), self._limit_mm))
        rung = int(np.argmin(np.abs(np.array(ladder) - used_mm)))
        if abs(ladder[rung] - used_mm) > _RADIUS_TOLERANCE_MM or (not is_reliable and rung != 0):
            return False
        kept = oracle.radius_mm[at]
        earlier = ladder[:rung] if is_reliable else ladder
        answers = []
        for radius_mm in earlier:
            oracle.radius_mm[at] = radius_mm
            answers.append(self._is_reliable(oracle.at(at)))  # type: ignore[no-untyped-call]
        oracle.radius_mm[at] = kept
        return True not in answers


def _wrong_normal(normal: npt.NDArray[np.float64], truth: OraclePoint) -> list[str]:
    """`sign` or `normal` when it differs from the singular value decomposition by more than 1e-6 rad."""
    if truth.normal is None:
        return ["normal"]
    along = float(normal @ truth.normal)
    across = float(np.linalg.norm(np.cross(normal, truth.normal)))
    if across > 1e-6:
        return ["normal"]
    return [] if along > 0 else ["sign"]
